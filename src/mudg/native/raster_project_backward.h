// From the gradient records of the tiles to gradients of the Gaussians' parameters and of the camera pose.
#pragma once

#include "raster_projection.h"
#include "raster_sh.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kPrefetchAhead = 6;  // Gaussians

// Gradients of one group of sixteen splats, by lane.
struct GroupGradient {
  alignas(64) float mean2d[2][kLanes];
  alignas(64) float inverse[3][kLanes];  // half the second moments: gradient of the inverse covariance (xx, xy summed
                                         // over both, yy)
  alignas(64) float depth[kLanes];
  alignas(64) float opacity[kLanes];       // of the opacity after anti-aliasing
  alignas(64) float rgb[3][kLanes];        // of the colour, 0 where it was cut off at zero
  alignas(64) float direction[3][kLanes];  // of the mean, by way of the viewing direction of the harmonics
};

struct RecordSums {
  float mass, x, y, xx, xy, yy, abs_x, abs_y;
  float channels[kMaxChannels];
};

// Sums the records of Gaussian g with the moments moved from tile centres to its mean. False: nothing contributed.
MUDG_INLINE bool sum_records(const RasterState& state, int g, float mean_x, float mean_y, RecordSums& out) {
  const int padded = state.padded_channels;
  std::memset(&out, 0, offsetof(RecordSums, channels) + sizeof(float) * padded);
  const TileEntry* entry = state.workers[state.entry_worker[g]].entries + state.entry_offset[g];
  const float* record = state.records + static_cast<std::size_t>(state.first_record[g]) * state.record_stride;
  bool any = false;
  const double inv_tiles_x = 1.0 / state.tiles_x;
  for (int k = 0; k < state.entry_counts[g]; ++k, record += state.record_stride) {
    std::uint32_t first_word;
    std::memcpy(&first_word, record, sizeof first_word);
    if (first_word == kNoContribution) continue;
    any = true;
    const int tile = entry[k].tile;
    const int tile_y = static_cast<int>((static_cast<double>(tile) + 0.5) * inv_tiles_x);  // tile / tiles_x, but faster
    const float x = mean_x - static_cast<float>((tile - tile_y * state.tiles_x) * kTileSize + kTileSize / 2);
    const float y = mean_y - static_cast<float>(tile_y * kTileSize + kTileSize / 2);
    const float m = record[0], mx = record[1], my = record[2];
    out.mass += m;
    out.x += x * m - mx;
    out.y += y * m - my;
    out.xx += x * x * m - 2.0f * x * mx + record[3];
    out.xy += x * y * m - x * my - y * mx + record[4];
    out.yy += y * y * m - 2.0f * y * my + record[5];
    out.abs_x += record[kAbsX];
    out.abs_y += record[kAbsY];
    for (int c = 0; c < padded; ++c) out.channels[c] += record[kRecordChannels + c];
  }
  return any;
}

MUDG_INLINE void zero_rows(const RasterScene& s, const RasterGradient& gradient, int g) {
  const std::size_t row = static_cast<std::size_t>(g);
  if (gradient.sh != nullptr) {
    const auto of_sh = harmonics_of(s, gradient.sh, gradient.sh_rest, row);
    of_sh.first[0] = of_sh.first[1] = of_sh.first[2] = 0.0f;
    std::memset(of_sh.rest, 0, sizeof(float) * 3 * (s.sh_coefficients - 1));
  }
  if (gradient.extra != nullptr)
    std::memset(gradient.extra + row * s.extra_channels, 0, sizeof(float) * s.extra_channels);
  if (gradient.means2d != nullptr) gradient.means2d[2 * row] = gradient.means2d[2 * row + 1] = 0.0f;
  if (gradient.abs_means2d != nullptr) gradient.abs_means2d[2 * row] = gradient.abs_means2d[2 * row + 1] = 0.0f;
}

// Gradients of the harmonics' coefficients, and of the mean through the viewing direction. `live`: bits of the lanes
// that contributed.
MUDG_INLINE void color_backward(const RasterState& state, const RasterGradient& gradient, int first, unsigned live,
                                GroupGradient& group) {
  const RasterScene& s = state.scene;
  Floats d[3];
  load_columns<3>(s.means, first, s.count, d);
  for (int k = 0; k < 3; ++k) d[k] = (d[k] - splat(s.center_high[k])) - splat(s.center_low[k]);
  const Floats squared = mul_add(d[0], d[0], mul_add(d[1], d[1], mul_add(d[2], d[2], splat(1e-24f))));
  const Floats inv_length = splat(1.0f) / sqrt_of(squared);
  for (int k = 0; k < 3; ++k) d[k] = d[k] * inv_length;
  const int active = s.sh_coefficients;
  Floats basis[kMaxSh], of_basis[kMaxSh];
  alignas(64) float columns[kMaxSh][kLanes];
  sh_basis(active, d[0], d[1], d[2], basis);
  for (int k = 0; k < active; ++k) store(columns[k], basis[k]);
  alignas(64) float of_columns[kMaxSh][kLanes] = {};
  for (unsigned left = live; left != 0; left &= left - 1) {
    const int l = __builtin_ctz(left);
    const std::size_t row = static_cast<std::size_t>(first + l);
    const auto sh = harmonics_of(s, s.sh, s.sh_rest, row);
    const float red = group.rgb[0][l], green = group.rgb[1][l], blue = group.rgb[2][l];
    float values[kMaxSh], of_values[kMaxSh];
    for (int k = 0; k < active; ++k) {
      const float* of_k = k == 0 ? sh.first : sh.rest + 3 * (k - 1);
      of_values[k] = of_k[0] * red + of_k[1] * green + of_k[2] * blue;
    }
    for (int k = 0; k < active; ++k) of_columns[k][l] = of_values[k];
    if (gradient.sh == nullptr) continue;
    const auto of_sh = harmonics_of(s, gradient.sh, gradient.sh_rest, row);
    for (int k = 0; k < active; ++k) values[k] = columns[k][l];
    for (int k = 0; k < active; ++k) {
      float* of_row = k == 0 ? of_sh.first : of_sh.rest + 3 * (k - 1);
      of_row[0] = values[k] * red;
      of_row[1] = values[k] * green;
      of_row[2] = values[k] * blue;
    }
  }
  if (active == 1) return;
  for (int k = 0; k < active; ++k) of_basis[k] = load(of_columns[k]);
  Floats v[3];
  sh_basis_backward(active, d[0], d[1], d[2], of_basis, v);
  const Floats along = dot3(v, d);
  for (int k = 0; k < 3; ++k) store(group.direction[k], neg_mul_add(along, d[k], v[k]) * inv_length);
}

// Brings closer what the gathering of Gaussian g will read and write.
MUDG_INLINE void prefetch_gaussian(const RasterState& state, const RasterGradient& gradient, int g) {
  const RasterScene& s = state.scene;
  const std::size_t row = static_cast<std::size_t>(g);
  const int rest = 3 * (s.sh_coefficients - 1);
  if (gradient.sh != nullptr) {
    const auto of_sh = harmonics_of(s, gradient.sh, gradient.sh_rest, row);
    __builtin_prefetch(of_sh.first, 1, 2);
    for (int at = 0; at < rest; at += 16) __builtin_prefetch(of_sh.rest + at, 1, 2);
  }
  if (state.entry_counts[g] == 0) return;
  const auto sh = harmonics_of(s, s.sh, s.sh_rest, row);
  __builtin_prefetch(sh.first, 0, 2);
  for (int at = 0; at < rest; at += 16) __builtin_prefetch(sh.rest + at, 0, 2);
  __builtin_prefetch(state.splats + static_cast<std::size_t>(g) * state.splat_stride, 0, 2);
  const std::size_t stride = static_cast<std::size_t>(state.record_stride);
  const float* record = state.records + state.first_record[g] * stride;
  const std::size_t bytes = smaller(state.entry_counts[g], 4) * stride;
  for (std::size_t at = 0; at < bytes; at += 16) __builtin_prefetch(record + at, 0, 2);
  __builtin_prefetch(state.workers[state.entry_worker[g]].entries + state.entry_offset[g], 0, 2);
}

// Reads the records of sixteen Gaussians. Returns whether any of them contributed to the image.
MUDG_INLINE bool gather_group(const RasterState& state, const RasterGradient& gradient, int first,
                              GroupGradient& group) {
  const RasterScene& s = state.scene;
  std::memset(&group, 0, sizeof group);
  unsigned live = 0;
  RecordSums sums;
  for (int l = 0; l < kLanes && first + l < s.count; ++l) {
    const int g = first + l;
    if (g + kPrefetchAhead < s.count) prefetch_gaussian(state, gradient, g + kPrefetchAhead);
    const float* splat_row = state.splats + static_cast<std::size_t>(g) * state.splat_stride;
    if (state.entry_counts[g] == 0 || !sum_records(state, g, splat_row[kMeanX], splat_row[kMeanY], sums)) {
      zero_rows(s, gradient, g);
      continue;
    }
    live |= 1u << l;
    const float a = splat_row[kStretch] * (2.0f * kLn2), b = splat_row[kShear] * a;
    const float c = splat_row[kHeight] * (2.0f * kLn2) + splat_row[kShear] * b;
    group.mean2d[0][l] = a * sums.x + b * sums.y;
    group.mean2d[1][l] = b * sums.x + c * sums.y;
    group.inverse[0][l] = 0.5f * sums.xx;
    group.inverse[1][l] = sums.xy;
    group.inverse[2][l] = 0.5f * sums.yy;
    group.opacity[l] = -sums.mass / splat_row[kOpacity];
    group.depth[l] = sums.channels[3];
    const std::size_t row = static_cast<std::size_t>(g);
    if (gradient.means2d != nullptr) {
      gradient.means2d[2 * row] = group.mean2d[0][l];
      gradient.means2d[2 * row + 1] = group.mean2d[1][l];
    }
    if (gradient.abs_means2d != nullptr) {
      gradient.abs_means2d[2 * row] = sums.abs_x;
      gradient.abs_means2d[2 * row + 1] = sums.abs_y;
    }
    if (gradient.extra != nullptr) {
      for (int k = 0; k < s.extra_channels; ++k) gradient.extra[row * s.extra_channels + k] = sums.channels[4 + k];
    }
    for (int c = 0; c < 3; ++c) group.rgb[c][l] = (state.clamped[g] >> c) & 1 ? 0.0f : sums.channels[c];
  }
  if (live != 0) color_backward(state, gradient, first, live, group);
  return live != 0;
}

struct CovarianceGradient {
  Floats xx, xy, yy;  // xy: of each of the two equal entries
};

// v_cov = -inv(cov) v_inverse inv(cov). Needle-like ellipses lose all digits here in float32, so it runs in double.
MUDG_INLINE CovarianceGradient covariance_backward(const Projection& p, const GroupGradient& group) {
  alignas(64) float xx[kLanes], xy[kLanes], yy[kLanes], det[kLanes], out_xx[kLanes], out_xy[kLanes], out_yy[kLanes];
  store(xx, p.cov_xx);
  store(xy, p.cov_xy);
  store(yy, p.cov_yy);
  store(det, max_of(p.det, splat(1e-10f)));
  for (int l = 0; l < kLanes; ++l) {
    const double a = xx[l], b = xy[l], d = yy[l], inv = 1.0 / det[l];
    const double ia = d * inv, ib = -b * inv, id = a * inv;
    const double v0 = group.inverse[0][l], v1 = 0.5 * group.inverse[1][l], v2 = group.inverse[2][l];
    const double t00 = ia * v0 + ib * v1, t01 = ia * v1 + ib * v2, t10 = ib * v0 + id * v1, t11 = ib * v1 + id * v2;
    out_xx[l] = static_cast<float>(-(t00 * ia + t01 * ib));
    out_xy[l] = static_cast<float>(-(t00 * ib + t01 * id));
    out_yy[l] = static_cast<float>(-(t10 * ib + t11 * id));
  }
  return {load(out_xx), load(out_xy), load(out_yy)};
}

// Splits the gradient of the compensated opacity into that of the opacity and a part of the covariance's.
MUDG_INLINE Floats compensation_backward(const Projection& p, Floats opacity, Floats of_opacity,
                                         CovarianceGradient& of_cov) {
  const Floats factor = compensation_of(p);
  const Mask live = factor > splat(1.5e-3f);
  const Floats half = splat(0.5f) * of_opacity * opacity * factor;  // gradient of ln(sharp_det / det)
  const Floats inv_sharp = splat(1.0f) / select(live, p.sharp_det, splat(1.0f));
  const Floats inv_det = splat(1.0f) / max_of(p.det, splat(1e-10f));
  of_cov.xx = of_cov.xx + keep(live, half * (p.sharp_yy * inv_sharp - p.cov_yy * inv_det));
  of_cov.yy = of_cov.yy + keep(live, half * (p.sharp_xx * inv_sharp - p.cov_xx * inv_det));
  of_cov.xy = of_cov.xy + keep(live, half * (p.cov_xy * inv_det - p.sharp_xy * inv_sharp));
  return of_opacity * factor;
}

MUDG_INLINE void quaternion_backward(const Projection& p, const Floats v[3][3], Floats out[4]) {
  const Floats w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3], two = splat(2.0f);
  const Floats of_unit[4] = {two * (x * (v[2][1] - v[1][2]) + y * (v[0][2] - v[2][0]) + z * (v[1][0] - v[0][1])),
                             two * (y * (v[1][0] + v[0][1]) + z * (v[2][0] + v[0][2]) + w * (v[2][1] - v[1][2]) -
                                    two * x * (v[1][1] + v[2][2])),
                             two * (x * (v[1][0] + v[0][1]) + z * (v[2][1] + v[1][2]) + w * (v[0][2] - v[2][0]) -
                                    two * y * (v[0][0] + v[2][2])),
                             two * (x * (v[2][0] + v[0][2]) + y * (v[2][1] + v[1][2]) + w * (v[1][0] - v[0][1]) -
                                    two * z * (v[0][0] + v[1][1]))};
  Floats along = splat(0.0f);
  for (int k = 0; k < 4; ++k) along = mul_add(of_unit[k], p.quat[k], along);
  for (int k = 0; k < 4; ++k) out[k] = neg_mul_add(along, p.quat[k], of_unit[k]) * p.inv_norm;
}

struct ParameterGradient {
  Floats mean[3], quat[4], scale[3], opacity;
};

// Parts of the camera's gradient: rotation (cam_from_world, 9) and centre (3).
constexpr int kCameraParts = 12;

MUDG_INLINE void group_backward(const RasterScene& s, int first, const GroupGradient& group, Mask drawn,
                                ParameterGradient& out, double* camera) {
  Projection p;
  Floats means[3], quats[4];
  project_sixteen(s, first, p, means, quats);
  CovarianceGradient of_cov = covariance_backward(p, group);
  out.opacity = load(group.opacity);
  if (s.antialias) {
    Floats opacity;
    load_columns<1>(s.opacities, first, s.count, &opacity);
    out.opacity = compensation_backward(p, opacity, out.opacity, of_cov);
  }
  // cov = M M^T with M = J R Q S (image_from_unit).
  Floats of_unit[2][3];
  for (int k = 0; k < 3; ++k) {
    of_unit[0][k] = splat(2.0f) * (of_cov.xx * p.image_from_unit[0][k] + of_cov.xy * p.image_from_unit[1][k]);
    of_unit[1][k] = splat(2.0f) * (of_cov.xy * p.image_from_unit[0][k] + of_cov.yy * p.image_from_unit[1][k]);
  }
  Floats of_rotation[3][3], of_world[2][3];
  for (int k = 0; k < 3; ++k) out.scale[k] = splat(0.0f);
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k) {
      const Floats of_axes = p.image_from_world[0][r] * of_unit[0][k] + p.image_from_world[1][r] * of_unit[1][k];
      of_rotation[r][k] = of_axes * p.scale[k];
      out.scale[k] = mul_add(of_axes, p.rotation[r][k], out.scale[k]);
    }
  }
  for (int r = 0; r < 2; ++r) {
    for (int k = 0; k < 3; ++k) {
      of_world[r][k] = of_unit[r][0] * p.rotation[k][0] * p.scale[0] + of_unit[r][1] * p.rotation[k][1] * p.scale[1] +
                       of_unit[r][2] * p.rotation[k][2] * p.scale[2];
    }
  }
  quaternion_backward(p, of_rotation, out.quat);

  Floats view[9];
  for (int k = 0; k < 9; ++k) view[k] = splat(s.rotation[k]);
  const Floats of_jxx = dot3(of_world[0], view), of_jxz = dot3(of_world[0], view + 6);
  const Floats of_jyy = dot3(of_world[1], view + 3), of_jyz = dot3(of_world[1], view + 6);
  const Floats fx = splat(s.fx), fy = splat(s.fy), inv_z = p.inv_z, inv_z2 = inv_z * inv_z;
  const Floats of_u = load(group.mean2d[0]), of_v = load(group.mean2d[1]);
  Floats of_cam[3];
  of_cam[0] = fx * inv_z * of_u;
  of_cam[1] = fy * inv_z * of_v;
  of_cam[2] = load(group.depth) - (fx * p.slope_x * of_u + fy * p.slope_y * of_v) * inv_z -
              (fx * of_jxx + fy * of_jyy) * inv_z2 + (fx * p.held_x * of_jxz + fy * p.held_y * of_jyz) * inv_z2;
  const Floats of_held_x = keep(p.free_x, splat(0.0f) - fx * inv_z * of_jxz);
  const Floats of_held_y = keep(p.free_y, splat(0.0f) - fy * inv_z * of_jyz);
  of_cam[0] = mul_add(of_held_x, inv_z, of_cam[0]);
  of_cam[1] = mul_add(of_held_y, inv_z, of_cam[1]);
  of_cam[2] = of_cam[2] - (of_held_x * p.slope_x + of_held_y * p.slope_y) * inv_z;

  // Lanes that were not drawn may hold anything (they were projected with a stand-in depth): drop them.
  for (int k = 0; k < 3; ++k) {
    const Floats of_offset = of_cam[0] * view[k] + of_cam[1] * view[3 + k] + of_cam[2] * view[6 + k];
    out.mean[k] = keep(drawn, of_offset + load(group.direction[k]));
    out.scale[k] = keep(drawn, out.scale[k]);
    camera[9 + k] -= sum(out.mean[k]);  // everything depends on mean - centre
  }
  for (int k = 0; k < 4; ++k) out.quat[k] = keep(drawn, out.quat[k]);
  out.opacity = keep(drawn, out.opacity);
  const Floats jxx = fx * inv_z, jxz = splat(0.0f) - fx * p.held_x * inv_z, jyy = fy * inv_z,
               jyz = splat(0.0f) - fy * p.held_y * inv_z;
  for (int k = 0; k < 3; ++k) {
    camera[k] += sum(keep(drawn, mul_add(of_cam[0], p.offset[k], jxx * of_world[0][k])));
    camera[3 + k] += sum(keep(drawn, mul_add(of_cam[1], p.offset[k], jyy * of_world[1][k])));
    camera[6 + k] += sum(keep(drawn, mul_add(of_cam[2], p.offset[k], jxz * of_world[0][k] + jyz * of_world[1][k])));
  }
}

void project_backward(RasterState& state, RasterGradient& gradient) {
  const RasterScene& s = state.scene;
  const std::int64_t groups = (static_cast<std::int64_t>(s.count) + kLanes - 1) / kLanes;
  const std::int64_t chunks = (groups + kCameraChunk - 1) / kCameraChunk;
  parallel_for(chunks, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t chunk = begin; chunk < end; ++chunk) {
      double* camera = state.camera_parts + chunk * 16;
      for (int k = 0; k < kCameraParts; ++k) camera[k] = 0.0;
      for (std::int64_t group = chunk * kCameraChunk; group < smaller(groups, (chunk + 1) * kCameraChunk); ++group) {
        const int first = static_cast<int>(group) * kLanes;
        GroupGradient of_splats;
        ParameterGradient out;
        std::memset(&out, 0, sizeof out);
        if (gather_group(state, gradient, first, of_splats)) {
          alignas(64) float drawn[kLanes];
          for (int l = 0; l < kLanes; ++l)
            drawn[l] = first + l < s.count && state.entry_counts[first + l] > 0 ? 1.0f : 0.0f;
          group_backward(s, first, of_splats, load(drawn) > splat(0.5f), out, camera);
        }
        store_columns<3>(gradient.means, first, s.count, out.mean);
        store_columns<4>(gradient.quats, first, s.count, out.quat);
        store_columns<3>(gradient.scales, first, s.count, out.scale);
        store_columns<1>(gradient.opacities, first, s.count, &out.opacity);
      }
    }
  });
  double total[kCameraParts] = {};
  for (std::int64_t chunk = 0; chunk < chunks; ++chunk) {
    for (int k = 0; k < kCameraParts; ++k) total[k] += state.camera_parts[chunk * 16 + k];
  }
  for (int k = 0; k < 9; ++k) gradient.rotation[k] = static_cast<float>(total[k]);
  for (int k = 0; k < 3; ++k) gradient.center[k] = static_cast<float>(total[9 + k]);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
