// C interface of the rasteriser: contexts, forward, backward.
#include <algorithm>
#include <chrono>
#include <ctime>
#include <new>

#include "api.h"
#include "cpu.h"
#include "kernels.h"
#include "raster_context.h"

namespace mudg {

const Kernels& kernels() {
#if defined(__x86_64__)
  switch (isa()) {
    case Isa::kAvx512: return kernels_avx512();
    case Isa::kAvx2: return kernels_avx2();
    case Isa::kPortable: break;
  }
#endif
  return kernels_portable();
}

namespace {

// Seconds: processor time where one thread does all the work (what others take of a busy machine does not count), else
// wall time.
double seconds_now(bool alone) {
#if defined(CLOCK_THREAD_CPUTIME_ID)
  timespec time{};
  if (alone && clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time) == 0)
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
#endif
  (void)alone;
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

class PhaseClock {
 public:
  explicit PhaseClock(RasterContext& context) : context_(context), since_(seconds_now(alone_)) {}
  void finish(RasterPhase phase) {
    const double now = seconds_now(alone_);
    context_.phase_s[phase] = now - since_;
    since_ = now;
  }

 private:
  const bool alone_ = thread_count() == 1;
  RasterContext& context_;
  double since_;
};

RasterStatus forward(RasterContext& context, const RasterScene& scene, RasterImage& image) {
  const Kernels& table = kernels();
  PhaseClock clock(context);
  if (!context.prepare(scene)) return RasterStatus::kOutOfMemory;
  table.project_forward(context.state, image);
  if (context.state.out_of_memory != 0) return RasterStatus::kOutOfMemory;
  if (context.state.not_finite_count > 0) return RasterStatus::kNotFinite;
  clock.finish(kPhaseProject);
  if (const RasterStatus status = context.sort_by_depth(); status != RasterStatus::kOk) return status;
  clock.finish(kPhaseSort);
  if (const RasterStatus status = context.bin_into_tiles(); status != RasterStatus::kOk) return status;
  clock.finish(kPhaseBin);
  table.blend_forward(context.state, image);
  clock.finish(kPhaseBlend);
  return RasterStatus::kOk;
}

RasterStatus backward(RasterContext& context, const RasterImageGradient& image, RasterGradient& gradient) {
  const Kernels& table = kernels();
  PhaseClock clock(context);
  if (!context.prepare_backward()) return RasterStatus::kOutOfMemory;
  table.blend_backward(context.state, image);
  clock.finish(kPhaseBlendBackward);
  table.project_backward(context.state, gradient);
  clock.finish(kPhaseProjectBackward);
  return RasterStatus::kOk;
}

// Pairs in the tiles' lists up to where the last pixel of each block was finished.
std::int64_t blended_pairs(const RasterState& s) {
  std::int64_t total = 0;
  for (int tile = 0; tile < s.tiles_x * s.tiles_y; ++tile) {
    const std::int32_t* last = s.last_item + static_cast<std::size_t>(tile) * kPixelsPerTile;
    std::int32_t block_last[kBlocksPerTile];
    for (int b = 0; b < kBlocksPerTile; ++b)
      block_last[b] = *std::max_element(last + b * kPixelsPerBlock, last + (b + 1) * kPixelsPerBlock);
    const std::int32_t begin = s.tile_start[tile], end = s.tile_start[tile + 1];
    for (std::int32_t i = begin; i < end; ++i) {
      for (unsigned left = s.items[i].blocks; left != 0; left &= left - 1)
        total += i - begin <= block_last[__builtin_ctz(left)];
    }
  }
  return total;
}

}  // namespace
}  // namespace mudg

extern "C" {

// A context keeps what the backward pass needs; it may be reused for another forward pass once that is over. Null: no
// memory.
MUDG_API mudg::RasterContext* mudg_raster_new() { return new (std::nothrow) mudg::RasterContext; }

MUDG_API void mudg_raster_free(mudg::RasterContext* context) { delete context; }

// Both return a RasterStatus. The inputs of the scene must stay unchanged until the backward pass is over.
MUDG_API int mudg_raster_forward(mudg::RasterContext* context, const mudg::RasterScene* scene,
                                 mudg::RasterImage* image) {
  return static_cast<int>(mudg::forward(*context, *scene, *image));
}

MUDG_API int mudg_raster_backward(mudg::RasterContext* context, const mudg::RasterImageGradient* image,
                                  mudg::RasterGradient* gradient) {
  return static_cast<int>(mudg::backward(*context, *image, *gradient));
}

// After a forward pass: visible Gaussians, tile entries, Gaussians with non-finite input, index of the first of those,
// the bytes that the context holds, and the pairs of a Gaussian and a 4x4 block that were blended; then seconds per
// phase of the last forward and backward pass.
MUDG_API void mudg_raster_statistics(const mudg::RasterContext* context, std::int64_t counts[6], double phase_s[6]) {
  counts[0] = context->state.visible_count;
  counts[1] = context->state.entry_count;
  counts[2] = context->state.not_finite_count;
  counts[3] = context->state.first_not_finite;
  counts[4] = static_cast<std::int64_t>(context->bytes());
  counts[5] = context->state.visible_count > 0 ? mudg::blended_pairs(context->state) : 0;
  for (int phase = 0; phase < mudg::kPhases; ++phase) phase_s[phase] = context->phase_s[phase];
}

// Floating-point operations of `rounds` rounds of independent multiply-adds on one thread (see peak.h).
MUDG_API double mudg_peak_multiply_add(std::int64_t rounds, float* sink) {
  return mudg::kernels().peak_multiply_add(rounds, sink);
}

}  // extern "C"
