// C interface of the fused training kernels: photometric loss, class loss, pictures over a coarse sky, box means, Adam, and
// look-ups in hash grids and in planes of place and time.
#include <cmath>
#include <new>

#include "api.h"
#include "buffer.h"
#include "kernels.h"

namespace {

constexpr int kMostGridLevels = 32, kMostPlaneLevels = 16;

}  // namespace

// Scratch memory is kept from call to call; one per thread that calls.
extern "C" {

// Value of the loss, and its gradient with respect to x (f32[planes][height][width], like y); weight f32[height][width] or null. NaN
// and status 1: no memory.
MUDG_API double mudg_photometric(const float* x, const float* y, const float* weight, int planes, int height, int width,
                                 float ssim_weight, float* gradient, int* status) {
  static thread_local mudg::Buffer<float> maps, workers;
  static thread_local mudg::Buffer<double> partial;
  mudg::PhotometricJob job{x, y, weight, planes, height, width, ssim_weight, gradient};
  job.padded_width = (width + 15) / 16 * 16;
  job.row_stride = job.padded_width + 2 * mudg::kPhotometricApron;
  job.worker_stride =
      static_cast<std::size_t>(4) * job.row_stride + static_cast<std::size_t>(44) * job.padded_width + 64;
  job.workers = mudg::thread_count();
  const std::size_t strips = static_cast<std::size_t>((height + mudg::kPhotometricStrip - 1) / mudg::kPhotometricStrip);
  const bool ok = maps.reserve(static_cast<std::size_t>(3) * planes * height * job.row_stride) &&
                  workers.reserve(job.worker_stride * job.workers) && partial.reserve(planes * strips);
  *status = ok ? 0 : 1;
  if (!ok) return NAN;
  job.maps = maps.data();
  job.worker_scratch = workers.data();
  job.partial = partial.data();
  return mudg::kernels().photometric(job);
}

// scale * sum of weight * cross entropy, and its gradient (f32[classes][pixels], like the logits). NaN and status 1: no
// memory.
MUDG_API double mudg_class_loss(const float* logits, const std::int64_t* target, const float* weight, const float* lift,
                                int raised, int classes, std::int64_t pixels, float scale, float* gradient,
                                int* status) {
  static thread_local mudg::Buffer<double> partial;
  static thread_local mudg::Buffer<float> workers;
  mudg::ClassLossJob job{logits, target, weight, lift, raised, classes, pixels, scale, gradient};
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
  static thread_local mudg::Buffer<float> row_sums, workers;
  static thread_local mudg::Buffer<std::int32_t> columns;
  mudg::OverJob job{rgb, alpha, coarse, sizes[0], sizes[1], sizes[2], sizes[3], sizes[4], out, gradient, of_alpha, of_coarse};
  job.workers = mudg::thread_count();
  const std::size_t rows = gradient == nullptr ? 0 : static_cast<std::size_t>(job.channels) * job.height;
  const std::size_t line = static_cast<std::size_t>(job.coarse_width) + job.width;
  if (!row_sums.reserve(rows * job.coarse_width) || !workers.reserve(line * job.workers) ||
      !columns.reserve(static_cast<std::size_t>(3) * job.width))
    return 1;
  job.row_sums = row_sums.data();
  job.worker_scratch = workers.data();
  job.columns = columns.data();
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
  const mudg::AdamJob job{columns,
                          column_count,
                          rows,
                          visible,
                          static_cast<float>(beta1),
                          static_cast<float>(beta2),
                          static_cast<float>(epsilon),
                          static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, count)))};
  if (rows > 0) mudg::kernels().adam(job);
}

// Features f32[points][levels * features] of points f32[points][dimensions] into `out`; or, with a gradient like `out`, the gradients
// of the table and of the points (each may be null). `sizes` holds dimensions, levels and features; every level has a
// resolution, its number of entries in the table, and whether they are hashed (then a power of two). Status 1: not such a grid.
MUDG_API int mudg_hash_grid(const float* x, std::int64_t points, const float* table, const int* sizes,
                            const std::int32_t* resolutions, const std::int64_t* entries, const std::uint8_t* hashed,
                            float* out, const float* gradient, float* of_table, float* of_x) {
  const int dimensions = sizes[0], level_count = sizes[1], features = sizes[2];
  const bool known = features == 1 || features == 2 || features == 4 || features == 8;
  if ((dimensions != 3 && dimensions != 4) || level_count < 1 || level_count > kMostGridLevels || !known) return 1;
  mudg::HashGridLevel levels[kMostGridLevels];
  std::int64_t offset = 0;
  for (int l = 0; l < level_count; ++l) {
    levels[l] = {offset, entries[l], resolutions[l], static_cast<std::uint32_t>(entries[l] - 1), hashed[l] != 0};
    offset += entries[l];
  }
  mudg::kernels().hash_grid({x, table, levels, dimensions, level_count, features, points, out, gradient, of_table, of_x});
  return 0;
}

// Features f32[points][levels * features] of places f32[points][4] into `out`; or, with a gradient like `out`, the gradients
// of the planes and of the places (each may be null; both are zero before). The planes lie one after the other, level by level, each
// [second axis][first axis][features]; `cells` i32[levels][4]: how many numbers a level has along x, y, z and t, at least 2. Status 1: not
// such planes; 2: no memory.
MUDG_API int mudg_hex_planes(const float* x, std::int64_t points, const float* planes, int features, int level_count,
                             const std::int32_t* cells, float* out, const float* gradient, float* of_planes, float* of_x) {
  const bool known = features == 1 || features == 2 || features == 4 || features == 8 || features == 16 || features == 32;
  if (!known || level_count < 1 || level_count > kMostPlaneLevels) return 1;
  mudg::HexPlanesLevel levels[kMostPlaneLevels];
  std::int64_t offset = 0;
  for (int l = 0; l < level_count; ++l) {
    for (int d = 0; d < 4; ++d) {
      levels[l].cells[d] = cells[l * 4 + d];
      if (levels[l].cells[d] < 2) return 1;
    }
    for (int p = 0; p < mudg::kHexPlanes; ++p) {
      levels[l].offset[p] = offset;
      const int* axes = mudg::kHexAxes[p];
      offset += static_cast<std::int64_t>(levels[l].cells[axes[0]]) * levels[l].cells[axes[1]] * features;
    }
  }
  try {
    mudg::kernels().hex_planes({x, planes, levels, level_count, features, points, out, gradient, of_planes, of_x});
  } catch (const std::bad_alloc&) {
    return 2;
  }
  return 0;
}

}  // extern "C"
