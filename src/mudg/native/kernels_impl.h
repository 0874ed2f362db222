// Included by kernels_portable.cpp, kernels_avx2.cpp and kernels_avx512.cpp, each compiled with its own flags.
#pragma once

#include "adam.h"
#include "box.h"
#include "classes.h"
#include "hash_grid.h"
#include "hex_planes.h"
#include "kernels.h"
#include "loss.h"
#include "over.h"
#include "peak.h"
#include "raster_backward.h"
#include "raster_forward.h"
#include "raster_project.h"
#include "raster_project_backward.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

template <int kChannels>
void blend_forward_channels(RasterState& state, float* const* planes, float* alpha) {
  parallel_for(state.tiles_x * state.tiles_y, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t tile = begin; tile < end; ++tile)
      blend_tile<kChannels>(state, static_cast<int>(tile), planes, alpha);
  });
}

void blend_forward(RasterState& state, RasterImage& image) {
  float* planes[kMaxChannels] = {};
  channel_planes(state, image, planes);
  switch (state.padded_channels) {
    case 4: return blend_forward_channels<4>(state, planes, image.alpha);
    case 8: return blend_forward_channels<8>(state, planes, image.alpha);
    case 12: return blend_forward_channels<12>(state, planes, image.alpha);
    case 16: return blend_forward_channels<16>(state, planes, image.alpha);
    case 20: return blend_forward_channels<20>(state, planes, image.alpha);
    case 24: return blend_forward_channels<24>(state, planes, image.alpha);
    case 28: return blend_forward_channels<28>(state, planes, image.alpha);
    default: return blend_forward_channels<32>(state, planes, image.alpha);
  }
}

template <int kChannels, bool kAbsolute>
void undo_all_tiles(RasterState& state, const float* const* planes, const float* alpha) {
  parallel_for(state.tiles_x * state.tiles_y, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t tile = begin; tile < end; ++tile)
      undo_tile<kChannels, kAbsolute>(state, static_cast<int>(tile), planes, alpha);
  });
}

template <int kChannels>
void blend_backward_channels(RasterState& state, const float* const* planes, const float* alpha) {
  if (state.scene.want_abs_gradient) {
    undo_all_tiles<kChannels, true>(state, planes, alpha);
  } else {
    undo_all_tiles<kChannels, false>(state, planes, alpha);
  }
}

void blend_backward(RasterState& state, const RasterImageGradient& image) {
  const float* planes[kMaxChannels] = {};
  channel_planes(state, image, planes);
  switch (state.padded_channels) {
    case 4: return blend_backward_channels<4>(state, planes, image.alpha);
    case 8: return blend_backward_channels<8>(state, planes, image.alpha);
    case 12: return blend_backward_channels<12>(state, planes, image.alpha);
    case 16: return blend_backward_channels<16>(state, planes, image.alpha);
    case 20: return blend_backward_channels<20>(state, planes, image.alpha);
    case 24: return blend_backward_channels<24>(state, planes, image.alpha);
    case 28: return blend_backward_channels<28>(state, planes, image.alpha);
    default: return blend_backward_channels<32>(state, planes, image.alpha);
  }
}

constexpr Kernels kTable = {project_forward, blend_forward, blend_backward, project_backward, photometric, adam,
                            class_loss, over, box_mean, hash_grid, hex_planes, peak_multiply_add};

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
