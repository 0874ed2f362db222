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
void blend_all_tiles(RasterState& state, float* const* planes, float* alpha) {
  parallel_for(state.tiles_x * state.tiles_y, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t tile = begin; tile < end; ++tile)
      blend_tile<kChannels>(state, static_cast<int>(tile), planes, alpha);
  });
}

template <int kChannels, bool kAbsolute>
void undo_all_tiles(RasterState& state, const float* const* planes, const float* alpha) {
  parallel_for(state.tiles_x * state.tiles_y, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t tile = begin; tile < end; ++tile)
      undo_tile<kChannels, kAbsolute>(state, static_cast<int>(tile), planes, alpha);
  });
}

// The loops over tiles for 4, 8, .. 32 channels.
constexpr decltype(&blend_all_tiles<4>) kBlend[] = {
    blend_all_tiles<4>,  blend_all_tiles<8>,  blend_all_tiles<12>, blend_all_tiles<16>,
    blend_all_tiles<20>, blend_all_tiles<24>, blend_all_tiles<28>, blend_all_tiles<32>};
template <bool kAbsolute>
constexpr decltype(&undo_all_tiles<4, false>) kUndo[] = {
    undo_all_tiles<4, kAbsolute>,  undo_all_tiles<8, kAbsolute>,  undo_all_tiles<12, kAbsolute>,
    undo_all_tiles<16, kAbsolute>, undo_all_tiles<20, kAbsolute>, undo_all_tiles<24, kAbsolute>,
    undo_all_tiles<28, kAbsolute>, undo_all_tiles<32, kAbsolute>};

void blend_forward(RasterState& state, RasterImage& image) {
  float* planes[kMaxChannels] = {};
  channel_planes(state, image, planes);
  kBlend[state.padded_channels / 4 - 1](state, planes, image.alpha);
}

void blend_backward(RasterState& state, const RasterImageGradient& image) {
  const float* planes[kMaxChannels] = {};
  channel_planes(state, image, planes);
  const auto* undo = state.scene.want_abs_gradient ? kUndo<true> : kUndo<false>;
  undo[state.padded_channels / 4 - 1](state, planes, image.alpha);
}

constexpr Kernels kTable = {project_forward, blend_forward, blend_backward, project_backward, photometric, adam,
                            class_loss, over, box_mean, hash_grid, hex_planes, peak_multiply_add};

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
