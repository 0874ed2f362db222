// The perspective projection of sixteen Gaussians at a time (EWA splatting), shared by the forward and the backward
// pass.
#pragma once

#include "raster_types.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Columns of a row-major array, sixteen rows from `first`; rows past the end repeat the last one.
template <int kColumns>
MUDG_INLINE void load_columns(const float* rows, int first, int count, Floats* out) {
  alignas(64) float lanes[kLanes];
  for (int c = 0; c < kColumns; ++c) {
    for (int l = 0; l < kLanes; ++l) {
      const int row = first + l < count ? first + l : count - 1;
      lanes[l] = rows[static_cast<std::size_t>(row) * kColumns + c];
    }
    out[c] = load(lanes);
  }
}

template <int kColumns>
MUDG_INLINE void store_columns(float* rows, int first, int count, const Floats* columns) {
  alignas(64) float lanes[kLanes];
  for (int c = 0; c < kColumns; ++c) {
    store(lanes, columns[c]);
    for (int l = 0; l < kLanes && first + l < count; ++l)
      rows[static_cast<std::size_t>(first + l) * kColumns + c] = lanes[l];
  }
}

struct Projection {
  Floats offset[3];          // mean - camera centre, world axes
  Floats cam[3];             // mean in camera axes
  Floats inv_z;              // 1 / z, or 1 for what lies in front of the near plane
  Floats slope_x, slope_y;   // x / z, y / z
  Floats held_x, held_y;     // the slopes at which the projection is linearised: held within 1.3 times the view
  Mask free_x, free_y;       // whether they are the slopes themselves
  Floats quat[4], inv_norm;  // unit quaternion and 1 / length of the given one
  Floats rotation[3][3];     // of the quaternion
  Floats scale[3];
  Floats image_from_world[2][3];        // J R: pixels per metre
  Floats image_from_unit[2][3];         // J R Q S: maps the unit sphere to the ellipse
  Floats sharp_xx, sharp_xy, sharp_yy;  // covariance in pixels^2
  Floats cov_xx, cov_xy, cov_yy;        // plus the blur
  Floats sharp_det, det;                // determinants of both
  Floats mean_x, mean_y;
};

MUDG_INLINE void rotation_of(const Floats q[4], Floats r[3][3]) {
  const Floats one = splat(1.0f), two = splat(2.0f);
  const Floats w = q[0], x = q[1], y = q[2], z = q[3];
  r[0][0] = one - two * (y * y + z * z);
  r[0][1] = two * (x * y - w * z);
  r[0][2] = two * (x * z + w * y);
  r[1][0] = two * (x * y + w * z);
  r[1][1] = one - two * (x * x + z * z);
  r[1][2] = two * (y * z - w * x);
  r[2][0] = two * (x * z - w * y);
  r[2][1] = two * (y * z + w * x);
  r[2][2] = one - two * (x * x + y * y);
}

MUDG_INLINE Floats dot3(const Floats* a, const Floats* b) {
  return mul_add(a[0], b[0], mul_add(a[1], b[1], a[2] * b[2]));
}

// `means`, `quats` receive the raw inputs, for checks.
MUDG_INLINE void project_sixteen(const RasterScene& s, int first, Projection& p, Floats means[3], Floats quats[4]) {
  load_columns<3>(s.means, first, s.count, means);
  load_columns<4>(s.quats, first, s.count, quats);
  load_columns<3>(s.scales, first, s.count, p.scale);
  // Subtracting the centre first keeps the precision of nearby Gaussians far from the world's origin.
  for (int k = 0; k < 3; ++k) p.offset[k] = (means[k] - splat(s.center_high[k])) - splat(s.center_low[k]);
  for (int k = 0; k < 3; ++k) {
    const float* row = s.rotation + 3 * k;
    p.cam[k] = mul_add(splat(row[0]), p.offset[0], mul_add(splat(row[1]), p.offset[1], splat(row[2]) * p.offset[2]));
  }
  const Floats z = select(p.cam[2] > splat(s.near_m), p.cam[2], splat(1.0f));
  p.inv_z = splat(1.0f) / z;

  const Floats squares =
      mul_add(quats[0], quats[0], mul_add(quats[1], quats[1], mul_add(quats[2], quats[2], quats[3] * quats[3])));
  p.inv_norm = splat(1.0f) / sqrt_of(max_of(squares, splat(1e-24f)));
  for (int k = 0; k < 4; ++k) p.quat[k] = quats[k] * p.inv_norm;
  rotation_of(p.quat, p.rotation);

  p.slope_x = p.cam[0] * p.inv_z;
  p.slope_y = p.cam[1] * p.inv_z;
  p.mean_x = mul_add(splat(s.fx), p.slope_x, splat(s.cx));
  p.mean_y = mul_add(splat(s.fy), p.slope_y, splat(s.cy));
  const float width = static_cast<float>(s.width), height = static_cast<float>(s.height);
  const float slack_x = 0.15f * width / s.fx, slack_y = 0.15f * height / s.fy;
  const Floats right = splat((width - s.cx) / s.fx + slack_x), left = splat(-(s.cx / s.fx + slack_x));
  const Floats bottom = splat((height - s.cy) / s.fy + slack_y), top = splat(-(s.cy / s.fy + slack_y));
  p.free_x = (p.slope_x <= right) & (p.slope_x >= left);
  p.free_y = (p.slope_y <= bottom) & (p.slope_y >= top);
  p.held_x = min_of(max_of(p.slope_x, left), right);
  p.held_y = min_of(max_of(p.slope_y, top), bottom);

  const Floats jxx = splat(s.fx) * p.inv_z, jxz = splat(-s.fx) * p.held_x * p.inv_z;
  const Floats jyy = splat(s.fy) * p.inv_z, jyz = splat(-s.fy) * p.held_y * p.inv_z;
  for (int c = 0; c < 3; ++c) {
    p.image_from_world[0][c] = mul_add(jxx, splat(s.rotation[c]), jxz * splat(s.rotation[6 + c]));
    p.image_from_world[1][c] = mul_add(jyy, splat(s.rotation[3 + c]), jyz * splat(s.rotation[6 + c]));
  }
  for (int r = 0; r < 2; ++r) {
    for (int c = 0; c < 3; ++c) {
      const Floats column[3] = {p.rotation[0][c], p.rotation[1][c], p.rotation[2][c]};
      p.image_from_unit[r][c] = dot3(p.image_from_world[r], column) * p.scale[c];
    }
  }
  p.sharp_xx = dot3(p.image_from_unit[0], p.image_from_unit[0]);
  p.sharp_xy = dot3(p.image_from_unit[0], p.image_from_unit[1]);
  p.sharp_yy = dot3(p.image_from_unit[1], p.image_from_unit[1]);
  p.cov_xx = p.sharp_xx + splat(s.blur_px2);
  p.cov_xy = p.sharp_xy;
  p.cov_yy = p.sharp_yy + splat(s.blur_px2);
  // By way of the cross product of the two rows: xx * yy - xy * xy would lose all digits for a long needle.
  const Floats *a = p.image_from_unit[0], *b = p.image_from_unit[1];
  const Floats cross[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
  p.sharp_det = dot3(cross, cross);
  p.det = mul_add(splat(s.blur_px2), p.sharp_xx + p.cov_yy, p.sharp_det);
}

// Anti-aliasing: the blur must not add light, so opacity shrinks by sqrt(det(sharp) / det(blurred)). Below 1e-3 nothing
// is visible anyway.
MUDG_INLINE Floats compensation_of(const Projection& p) {
  return sqrt_of(max_of(p.sharp_det / max_of(p.det, splat(1e-10f)), splat(1e-6f)));
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
