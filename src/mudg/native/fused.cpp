// C interface of the fused training kernels: photometric loss, class loss, pictures over a coarse sky, box means, and Adam.
#include <cmath>

#include "api.h"
#include "buffer.h"
#include "kernels.h"

namespace {

// Scratch memory of the loss, kept from call to call; one per thread that calls.
struct PhotometricScratch {
  mudg::Buffer<float> maps, workers;
  mudg::Buffer<double> partial;
};

struct OverScratch {
  mudg::Buffer<float> row_sums, workers;
  mudg::Buffer<std::int32_t> columns;
};

// Fills in what both directions share; false: no memory.
bool prepare_over(OverScratch& scratch, mudg::OverJob& job) {
  job.workers = mudg::thread_count();
  const std::size_t rows = job.gradient == nullptr ? 0 : static_cast<std::size_t>(job.channels) * job.height;
  const std::size_t line = static_cast<std::size_t>(job.coarse_width) + job.width;
  if (!scratch.row_sums.reserve(rows * job.coarse_width) || !scratch.workers.reserve(line * job.workers) ||
      !scratch.columns.reserve(static_cast<std::size_t>(3) * job.width))
    return false;
  job.row_sums = scratch.row_sums.data();
  job.worker_scratch = scratch.workers.data();
  job.columns = scratch.columns.data();
  return true;
}

}  // namespace

extern "C" {

// Value of the loss, and its gradient with respect to x (f32[planes][height][width], like y); weight f32[height][width] or null. NaN
// and status 1: no memory.
MUDG_API double mudg_photometric(const float* x, const float* y, const float* weight, int planes, int height, int width,
                                 float ssim_weight, float* gradient, int* status) {
  static thread_local PhotometricScratch scratch;
  mudg::PhotometricJob job{};
  job.x = x;
  job.y = y;
  job.weight = weight;
  job.planes = planes;
  job.height = height;
  job.width = width;
  job.ssim_weight = ssim_weight;
  job.gradient = gradient;
  job.padded_width = (width + 15) / 16 * 16;
  job.row_stride = job.padded_width + 2 * mudg::kPhotometricApron;
  job.worker_stride =
      static_cast<std::size_t>(4) * job.row_stride + static_cast<std::size_t>(44) * job.padded_width + 64;
  job.workers = mudg::thread_count();
  const std::size_t strips = static_cast<std::size_t>((height + mudg::kPhotometricStrip - 1) / mudg::kPhotometricStrip);
  const bool ok = scratch.maps.reserve(static_cast<std::size_t>(3) * planes * height * job.row_stride) &&
                  scratch.workers.reserve(job.worker_stride * job.workers) && scratch.partial.reserve(planes * strips);
  *status = ok ? 0 : 1;
  if (!ok) return NAN;
  job.maps = scratch.maps.data();
  job.worker_scratch = scratch.workers.data();
  job.partial = scratch.partial.data();
  return mudg::kernels().photometric(job);
}

// scale * sum of weight * cross entropy, and its gradient (f32[classes][pixels], like the logits). NaN and status 1: no
// memory.
MUDG_API double mudg_class_loss(const float* logits, const std::int64_t* target, const float* weight, const float* lift,
                                int raised, int classes, std::int64_t pixels, float scale, float* gradient,
                                int* status) {
  static thread_local mudg::Buffer<double> partial;
  static thread_local mudg::Buffer<float> workers;
  mudg::ClassLossJob job{};
  job.logits = logits;
  job.target = target;
  job.weight = weight;
  job.lift = lift;
  job.raised = raised;
  job.classes = classes;
  job.pixels = pixels;
  job.scale = scale;
  job.gradient = gradient;
  job.workers = mudg::thread_count();
  const std::int64_t pieces = (pixels + mudg::kClassLossPiece - 1) / mudg::kClassLossPiece;
  const bool ok = partial.reserve(static_cast<std::size_t>(pieces)) &&
                  workers.reserve(static_cast<std::size_t>(job.workers) * classes * mudg::kClassLossBlock);
  *status = ok ? 0 : 1;
  if (!ok) return NAN;
  job.partial = partial.data();
  job.worker_scratch = workers.data();
  return mudg::kernels().class_loss(job);
}

// rgb + (1 - alpha) * coarse enlarged to [channels][height][width]; `sizes` holds channels, height, width, coarse height and
// coarse width. With a gradient: writes those of alpha and coarse instead. Status 1: no memory.
MUDG_API int mudg_over(const float* rgb, const float* alpha, const float* coarse, const int* sizes, float* out,
                       const float* gradient, float* of_alpha, float* of_coarse) {
  static thread_local OverScratch scratch;
  mudg::OverJob job{};
  job.rgb = rgb;
  job.alpha = alpha;
  job.coarse = coarse;
  job.channels = sizes[0];
  job.height = sizes[1];
  job.width = sizes[2];
  job.coarse_height = sizes[3];
  job.coarse_width = sizes[4];
  job.out = out;
  job.gradient = gradient;
  job.of_alpha = of_alpha;
  job.of_coarse = of_coarse;
  if (!prepare_over(scratch, job)) return 1;
  mudg::kernels().over(job);
  return 0;
}

// Means over squares of 2 radius + 1 pixels, or the transposed map, of f32[planes][height][width]. Status 1: no memory.
MUDG_API int mudg_box_mean(const float* x, int planes, int height, int width, int radius, int transposed, float* out) {
  static thread_local mudg::Buffer<float> workers;
  mudg::BoxJob job{x, planes, height, width, radius, transposed != 0, out, nullptr, mudg::thread_count()};
  if (!workers.reserve((static_cast<std::size_t>(width) + 2 * radius) * job.workers)) return 1;
  job.worker_scratch = workers.data();
  mudg::kernels().box_mean(job);
  return 0;
}

// One Adam step in place on the columns of a table; visible u8[rows] or null. `step` counts from 1.
MUDG_API void mudg_adam(mudg::AdamColumn* columns, int column_count, std::int64_t rows, const std::uint8_t* visible,
                        double beta1, double beta2, double epsilon, std::int64_t step) {
  const double count = static_cast<double>(step);
  for (int c = 0; c < column_count; ++c)
    columns[c].step_size = static_cast<float>(columns[c].rate / (1.0 - std::pow(beta1, count)));
  mudg::AdamJob job{};
  job.columns = columns;
  job.column_count = column_count;
  job.rows = rows;
  job.visible = visible;
  job.beta1 = static_cast<float>(beta1);
  job.beta2 = static_cast<float>(beta2);
  job.epsilon = static_cast<float>(epsilon);
  job.inv_root_bias2 = static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, count)));
  if (rows > 0) mudg::kernels().adam(job);
}

}  // extern "C"
