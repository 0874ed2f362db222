// C interface of the fused training kernels: photometric loss and Adam.
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

}  // namespace

extern "C" {

// Value of the loss, and its gradient with respect to x (f32[planes][height][width], like y). NaN and status 1: no
// memory.
MUDG_API double mudg_photometric(const float* x, const float* y, int planes, int height, int width, float ssim_weight,
                                 float* gradient, int* status) {
  static thread_local PhotometricScratch scratch;
  mudg::PhotometricJob job{};
  job.x = x;
  job.y = y;
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
