// C interface of the six planes of several sizes.
#include "api.h"
#include <new>

#include "kernels.h"

namespace {

constexpr int kMostLevels = 16;
constexpr int kAxes[mudg::kHexPlanes][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};

}  // namespace

extern "C" {

// Features f32[points][levels * features] of places f32[points][4] into `out`; or, with a gradient like `out`, the gradients
// of the planes and of the places (each may be null; both are zero before). The planes lie one after the other, level by level, each
// [second axis][first axis][features]; `cells` i32[levels][4]: how many numbers a level has along x, y, z and t, at least 2. Status 1: not
// such planes; 2: no memory.
MUDG_API int mudg_hex_planes(const float* x, std::int64_t points, const float* planes, int features, int level_count,
                             const std::int32_t* cells, float* out, const float* gradient, float* of_planes, float* of_x) {
  const bool known = features == 1 || features == 2 || features == 4 || features == 8 || features == 16 || features == 32;
  if (!known || level_count < 1 || level_count > kMostLevels) return 1;
  mudg::HexPlanesLevel levels[kMostLevels];
  std::int64_t offset = 0;
  for (int l = 0; l < level_count; ++l) {
    for (int d = 0; d < 4; ++d) {
      levels[l].cells[d] = cells[l * 4 + d];
      if (levels[l].cells[d] < 2) return 1;
    }
    for (int p = 0; p < mudg::kHexPlanes; ++p) {
      levels[l].offset[p] = offset;
      offset += static_cast<std::int64_t>(levels[l].cells[kAxes[p][0]]) * levels[l].cells[kAxes[p][1]] * features;
    }
  }
  mudg::HexPlanesJob job{};
  job.x = x;
  job.planes = planes;
  job.levels = levels;
  job.level_count = level_count;
  job.features = features;
  job.points = points;
  job.out = out;
  job.gradient = gradient;
  job.of_planes = of_planes;
  job.of_x = of_x;
  try {
    mudg::kernels().hex_planes(job);
  } catch (const std::bad_alloc&) {
    return 2;
  }
  return 0;
}

}  // extern "C"
