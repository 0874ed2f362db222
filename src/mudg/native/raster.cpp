// C interface of the rasteriser: contexts, forward, backward.
#include <chrono>
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

class PhaseClock {
 public:
  explicit PhaseClock(RasterContext& context) : context_(context), since_(Clock::now()) {}
  void finish(RasterPhase phase) {
    const Clock::time_point now = Clock::now();
    context_.phase_s[phase] = std::chrono::duration<double>(now - since_).count();
    since_ = now;
  }

 private:
  using Clock = std::chrono::steady_clock;
  RasterContext& context_;
  Clock::time_point since_;
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
// the bytes that the context holds, and the pairs of a Gaussian and a 4x4 block in the tiles' lists; then seconds per phase of the last forward and backward pass.
MUDG_API void mudg_raster_statistics(const mudg::RasterContext* context, std::int64_t counts[6], double phase_s[6]) {
  counts[0] = context->state.visible_count;
  counts[1] = context->state.entry_count;
  counts[2] = context->state.not_finite_count;
  counts[3] = context->state.first_not_finite;
  counts[4] = static_cast<std::int64_t>(context->bytes());
  counts[5] = 0;
  for (std::int64_t i = 0; i < context->state.entry_count; ++i)
    counts[5] += __builtin_popcount(context->state.items[i].blocks);
  for (int phase = 0; phase < mudg::kPhases; ++phase) phase_s[phase] = context->phase_s[phase];
}

// Floating-point operations of `rounds` rounds of independent multiply-adds on one thread (see peak.h).
MUDG_API double mudg_peak_multiply_add(std::int64_t rounds, float* sink) {
  return mudg::kernels().peak_multiply_add(rounds, sink);
}

}  // extern "C"
