// What the two blending passes share: the alpha of a Gaussian on one 4x4 block, and the gathering of a stretch of a
// tile's list.
#pragma once

#include "raster_types.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kChunk = 128;  // list entries worked on at a time; their parameters then fit into the first-level cache
alignas(64) constexpr float kPixelX[kPixelsPerBlock] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kPixelY[kPixelsPerBlock] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// Evaluated by the same code forward and backward, so that both agree bit for bit on which pixels are touched.
struct Alpha {
  Floats dx, dy;  // mean - pixel
  Floats raw;     // before the cap
  Floats value;
  Mask counts;  // at least 1/255, and a proper ellipse
};
MUDG_INLINE Alpha alpha_of(const float* splat_row, Floats pixel_x, Floats pixel_y, Floats cap) {
  Alpha a;
  a.dx = splat(splat_row[kMeanX]) - pixel_x;
  a.dy = splat(splat_row[kMeanY]) - pixel_y;
  const Floats top = splat(splat_row[kLogOpacity]);
  const Floats sheared = mul_add(splat(splat_row[kShear]), a.dy, a.dx);
  const Floats fall = mul_add(splat(splat_row[kStretch]) * sheared, sheared, (splat(splat_row[kHeight]) * a.dy) * a.dy);
  const Floats power = top - fall;
  a.counts = (power >= splat(-kLog2Of255)) & (power <= top);
  a.raw = exp2_of(power);
  a.value = min_of(a.raw, cap);
  return a;
}

// The splat rows of up to kChunk list entries side by side, and for every block the entries that touch it.
template <int kChannels>
struct Chunk {
  static constexpr int kRow = kFirstChannel + kChannels;
  alignas(64) float rows[kChunk * kRow];
  std::uint8_t entries[kBlocksPerTile][kChunk];
  int counts[kBlocksPerTile];

  MUDG_INLINE const float* row(int entry) const { return rows + entry * kRow; }

  MUDG_INLINE void gather(const RasterState& state, const TileItem* items, int size, unsigned wanted_blocks) {
    std::memset(counts, 0, sizeof counts);
    for (int i = 0; i < size; ++i) {
      if (i + 12 < size) {
        const float* later = state.splats + static_cast<std::size_t>(items[i + 12].gaussian) * state.splat_stride;
        __builtin_prefetch(later);
        if (kRow > 16) __builtin_prefetch(later + 16);
      }
      const float* from = state.splats + static_cast<std::size_t>(items[i].gaussian) * state.splat_stride;
      float* to = rows + i * kRow;
      for (int k = 0; k < kRow; k += 4) std::memcpy(to + k, from + k, 16);
      for (unsigned left = items[i].blocks & wanted_blocks; left != 0; left &= left - 1) {
        const int block = __builtin_ctz(left);
        entries[block][counts[block]++] = static_cast<std::uint8_t>(i);
      }
    }
  }
};

// Position of a tile and of its blocks in the image.
struct TilePlace {
  int x, y;           // first pixel
  int width, height;  // of the image
  MUDG_INLINE TilePlace(const RasterState& state, int tile)
      : x(tile % state.tiles_x * kTileSize),
        y(tile / state.tiles_x * kTileSize),
        width(state.scene.width),
        height(state.scene.height) {}
  MUDG_INLINE int block_x(int block) const { return x + (block & 3) * kBlockSize; }
  MUDG_INLINE int block_y(int block) const { return y + (block >> 2) * kBlockSize; }
  MUDG_INLINE bool whole() const { return x + kTileSize <= width && y + kTileSize <= height; }
  MUDG_INLINE Floats pixel_x(int block) const {
    return load(kPixelX) + splat(static_cast<float>(block_x(block)) + 0.5f);
  }
  MUDG_INLINE Floats pixel_y(int block) const {
    return load(kPixelY) + splat(static_cast<float>(block_y(block)) + 0.5f);
  }
};

// One address per channel: R, G, B, depth, features.
template <class Pointer, class Image>
MUDG_INLINE void channel_planes(const RasterState& state, const Image& image, Pointer* planes) {
  const std::size_t pixels = static_cast<std::size_t>(state.scene.width) * state.scene.height;
  for (int c = 0; c < 3; ++c) planes[c] = image.rgb == nullptr ? nullptr : image.rgb + c * pixels;
  planes[3] = image.depth;
  for (int c = 4; c < state.channels; ++c)
    planes[c] = image.extra == nullptr ? nullptr : image.extra + (c - 4) * pixels;
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
