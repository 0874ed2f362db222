// Forward projection: every Gaussian becomes a splat (ellipse, opacity, channel values) and a list of touched tiles, or
// is culled.
#pragma once

#include "raster_footprint.h"
#include "raster_projection.h"
#include "raster_sh.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// The lanes of one group of sixteen, spilled for the scalar part.
struct SplatLanes {
  alignas(64) float mean_x[kLanes], mean_y[kLanes], depth[kLanes], opacity[kLanes], log_opacity[kLanes];
  alignas(64) float determinant[kLanes], conic_xx[kLanes], shear[kLanes], inv_cov_yy[kLanes], lean[kLanes];
  alignas(64) float level[kLanes], extent_x[kLanes], extent_y[kLanes];
  alignas(64) float basis[kMaxSh][kLanes];
};

// Returns the bits of the lanes whose inputs are all finite.
MUDG_INLINE unsigned project_lanes(const RasterScene& s, int first, SplatLanes& out) {
  Projection p;
  Floats means[3], quats[4], opacity;
  project_sixteen(s, first, p, means, quats);
  load_columns<1>(s.opacities, first, s.count, &opacity);
  const Floats zero = splat(0.0f);
  Floats poison = opacity * zero;  // stays zero unless something is NaN or infinite
  for (int k = 0; k < 3; ++k) poison = mul_add(means[k], zero, mul_add(p.scale[k], zero, poison));
  for (int k = 0; k < 4; ++k) poison = mul_add(quats[k], zero, poison);

  if (s.antialias) opacity = opacity * compensation_of(p);
  const Floats log_opacity = log2_of(max_of(opacity, splat(1e-30f)));
  const Floats inv_cov_yy = splat(1.0f) / p.cov_yy;
  // Squared Mahalanobis radius at which alpha falls to 1/255.
  const Floats level = max_of(splat(2.0f * kLn2) * (log_opacity + splat(kLog2Of255)), zero);
  store(out.mean_x, p.mean_x);
  store(out.mean_y, p.mean_y);
  store(out.depth, p.cam[2]);
  store(out.opacity, opacity);
  store(out.log_opacity, log_opacity);
  store(out.determinant, p.det);
  store(out.conic_xx, p.cov_yy / max_of(p.det, splat(1e-10f)));
  store(out.shear, zero - p.cov_xy * inv_cov_yy);
  store(out.inv_cov_yy, inv_cov_yy);
  store(out.lean, p.cov_xy / p.cov_xx);
  store(out.level, level);
  store(out.extent_x, sqrt_of(level * p.cov_xx));
  store(out.extent_y, sqrt_of(level * p.cov_yy));

  const Floats inv_length =
      splat(1.0f) /
      sqrt_of(mul_add(p.offset[0], p.offset[0],
                      mul_add(p.offset[1], p.offset[1], mul_add(p.offset[2], p.offset[2], splat(1e-24f)))));
  Floats basis[kMaxSh];
  sh_basis(s.sh_coefficients, p.offset[0] * inv_length, p.offset[1] * inv_length, p.offset[2] * inv_length, basis);
  for (int k = 0; k < s.sh_coefficients; ++k) store(out.basis[k], basis[k]);
  return bits((poison >= zero) & (poison <= zero));
}

// Pixels whose centre may lie inside: false when there are none.
MUDG_INLINE bool pixel_rectangle(const RasterScene& s, const SplatLanes& lanes, int l, Footprint& f) {
  const float reach_x = lanes.extent_x[l] * 1.00001f + 1e-3f, reach_y = lanes.extent_y[l] * 1.00001f + 1e-3f;
  const float left = lanes.mean_x[l] - reach_x - 0.5f, right = lanes.mean_x[l] + reach_x - 0.5f;
  const float top = lanes.mean_y[l] - reach_y - 0.5f, bottom = lanes.mean_y[l] + reach_y - 0.5f;
  const float last_x = static_cast<float>(s.width - 1), last_y = static_cast<float>(s.height - 1);
  if (!(right >= 0 && bottom >= 0 && left <= last_x && top <= last_y)) return false;  // NaN ends here too
  f.left = left <= 0 ? 0 : static_cast<int>(__builtin_ceilf(left));
  f.right = right >= last_x ? s.width - 1 : static_cast<int>(right);
  f.top = top <= 0 ? 0 : static_cast<int>(__builtin_ceilf(top));
  f.bottom = bottom >= last_y ? s.height - 1 : static_cast<int>(bottom);
  return f.left <= f.right && f.top <= f.bottom;
}

MUDG_INLINE bool footprint_of(const RasterScene& s, const SplatLanes& lanes, int l, Footprint& f) {
  const bool drawable = lanes.depth[l] > s.near_m && lanes.depth[l] < kFar && lanes.log_opacity[l] >= -kLog2Of255 &&
                        lanes.determinant[l] > 0.0f && lanes.conic_xx[l] > 0.0f && lanes.inv_cov_yy[l] > 0.0f;
  if (!drawable || !pixel_rectangle(s, lanes, l, f)) return false;
  const float inv_stretch = 1.0f / lanes.conic_xx[l];
  f.mean_x = lanes.mean_x[l];
  f.mean_y = lanes.mean_y[l];
  f.shear = lanes.shear[l];
  f.ratio = lanes.inv_cov_yy[l] * inv_stretch;
  f.half_width2 = lanes.level[l] * inv_stretch * 1.00002f;
  f.extreme_y = lanes.lean[l] * lanes.extent_x[l];
  return true;
}

// Writes the splat row. False when its colour or features are not finite.
MUDG_INLINE bool write_splat(RasterState& state, const SplatLanes& lanes, int l, int g) {
  const RasterScene& s = state.scene;
  float* row = state.splats + static_cast<std::size_t>(g) * state.splat_stride;
  row[kMeanX] = lanes.mean_x[l];
  row[kMeanY] = lanes.mean_y[l];
  row[kStretch] = 0.5f * kLog2E * lanes.conic_xx[l];
  row[kShear] = lanes.shear[l];
  row[kHeight] = 0.5f * kLog2E * lanes.inv_cov_yy[l];
  row[kLogOpacity] = lanes.log_opacity[l];
  row[kOpacity] = lanes.opacity[l];
  row[kDepth] = lanes.depth[l];
  float* channel = row + kFirstChannel;
  const auto harmonics = harmonics_of(s, s.sh, s.sh_rest, static_cast<std::size_t>(g));
  sh_color(harmonics.first, harmonics.rest, &lanes.basis[0][l], kLanes, s.sh_coefficients, channel);
  float poison = (channel[0] * 0.0f + channel[1] * 0.0f) + channel[2] * 0.0f;
  std::uint8_t clamped = 0;
  for (int c = 0; c < 3; ++c) {
    if (channel[c] < 0.0f) {
      channel[c] = 0.0f;
      clamped = static_cast<std::uint8_t>(clamped | (1 << c));
    }
  }
  state.clamped[g] = clamped;
  channel[3] = lanes.depth[l];
  const float* extra = s.extra + static_cast<std::size_t>(g) * s.extra_channels;
  for (int c = 0; c < s.extra_channels; ++c) {
    channel[4 + c] = extra[c];
    poison += extra[c] * 0.0f;
  }
  for (int c = state.channels; c < state.padded_channels; ++c) channel[c] = 0.0f;
  return poison == 0.0f;
}

void note_not_finite(RasterState& state, std::int64_t g) {
  __atomic_fetch_add(&state.not_finite_count, 1, __ATOMIC_RELAXED);
  std::int64_t seen = __atomic_load_n(&state.first_not_finite, __ATOMIC_RELAXED);
  while (g < seen &&
         !__atomic_compare_exchange_n(&state.first_not_finite, &seen, g, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

void project_group(RasterState& state, RasterImage& image, int first, int worker_id) {
  const RasterScene& s = state.scene;
  WorkerEntries& worker = state.workers[worker_id];
  SplatLanes lanes;
  const unsigned finite = project_lanes(s, first, lanes);
  const std::size_t used_before = worker.used;
  for (int l = 0; l < kLanes && first + l < s.count; ++l) {
    const int g = first + l;
    const bool is_finite = (finite >> l) & 1u;
    if (!is_finite) note_not_finite(state, g);
    Footprint f;
    int touched = 0;
    const std::size_t offset = worker.used;
    if (is_finite && footprint_of(s, lanes, l, f)) {
      const std::size_t tiles =
          static_cast<std::size_t>((f.right >> 4) - (f.left >> 4) + 1) * ((f.bottom >> 4) - (f.top >> 4) + 1);
      TileEntry* out = worker.room(larger<std::size_t>(tiles + 1, 16));
      if (out == nullptr || offset + tiles >= kHidden) {
        __atomic_store_n(&state.out_of_memory, 1, __ATOMIC_RELAXED);
      } else {
        touched = emit_footprint(f, state.tiles_x, out);
      }
    }
    worker.used += static_cast<std::size_t>(touched);
    state.entry_counts[g] = touched;
    const bool drawn = touched > 0;
    image.radii[2 * g] = drawn ? larger(1, static_cast<int>(__builtin_ceilf(lanes.extent_x[l]))) : 0;
    image.radii[2 * g + 1] = drawn ? larger(1, static_cast<int>(__builtin_ceilf(lanes.extent_y[l]))) : 0;
    image.means2d[2 * g] = drawn ? lanes.mean_x[l] : 0.0f;
    image.means2d[2 * g + 1] = drawn ? lanes.mean_y[l] : 0.0f;
    if (!drawn) {
      state.depth_key[g] = kHidden;
      continue;
    }
    state.entry_offset[g] = static_cast<std::uint32_t>(offset);
    state.entry_worker[g] = static_cast<std::uint8_t>(worker_id);
    std::memcpy(&state.depth_key[g], &lanes.depth[l], sizeof(float));
    if (!write_splat(state, lanes, l, g)) note_not_finite(state, g);
  }
  for (std::size_t e = used_before; e < worker.used; ++e) ++worker.tile_counts[worker.entries[e].tile];
}

void project_forward(RasterState& state, RasterImage& image) {
  const std::int64_t groups = (static_cast<std::int64_t>(state.scene.count) + kLanes - 1) / kLanes;
  parallel_for(
      groups, 32,
      [&](std::int64_t begin, std::int64_t end, int worker) {
        for (std::int64_t group = begin; group < end; ++group)
          project_group(state, image, static_cast<int>(group) * kLanes, worker);
      },
      state.worker_count);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
