// C interface of the multi-resolution hash grid.
#include "api.h"
#include "kernels.h"

namespace {

constexpr int kMostLevels = 32;

}  // namespace

extern "C" {

// Features f32[points][levels * features] of points f32[points][dimensions] into `out`; or, with a gradient like `out`, the gradients
// of the table and of the points (each may be null). `sizes` holds dimensions, levels and features; every level has a
// resolution, its number of entries in the table, and whether they are hashed (then a power of two). Status 1: not such a grid.
MUDG_API int mudg_hash_grid(const float* x, std::int64_t points, const float* table, const int* sizes,
                            const std::int32_t* resolutions, const std::int64_t* entries, const std::uint8_t* hashed,
                            float* out, const float* gradient, float* of_table, float* of_x) {
  mudg::HashGridJob job{};
  job.dimensions = sizes[0];
  job.level_count = sizes[1];
  job.features = sizes[2];
  const bool known = job.features == 1 || job.features == 2 || job.features == 4 || job.features == 8;
  if ((job.dimensions != 3 && job.dimensions != 4) || job.level_count < 1 || job.level_count > kMostLevels || !known) return 1;
  mudg::HashGridLevel levels[kMostLevels];
  std::int64_t offset = 0;
  for (int l = 0; l < job.level_count; ++l) {
    levels[l] = {offset, entries[l], resolutions[l], static_cast<std::uint32_t>(entries[l] - 1), hashed[l] != 0};
    offset += entries[l];
  }
  job.x = x;
  job.table = table;
  job.levels = levels;
  job.points = points;
  job.out = out;
  job.gradient = gradient;
  job.of_table = of_table;
  job.of_x = of_x;
  mudg::kernels().hash_grid(job);
  return 0;
}

}  // extern "C"
