// What the two blending passes share: the alpha of a Gaussian on one 4x4 block, and the gathering of a stretch of a
// tile's list.
#pragma once

#include "raster_types.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kChunk = 64;  // list entries worked on at a time; their parameters then fit into the first-level cache
alignas(64) constexpr float kPixelX[kPixelsPerBlock] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kPixelY[kPixelsPerBlock] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

constexpr int round_up(int value, int step) { return (value + step - 1) / step * step; }
constexpr int kBatch = 16;  // list entries of a block whose alphas are worked out before they are used

// The entries of a chunk that touch each block, as numbers within the chunk.
struct BlockLists {
  std::uint8_t entries[kBlocksPerTile][kChunk + 16];  // `append` and raw_alphas write and read beyond the end
  int counts[kBlocksPerTile];

  // Takes in sixteen entries, numbered from `first`; bit b of masks[i] says whether entry first + i touches block b.
  // Blocks in the outer loop: how many blocks an entry touches cannot be foreseen, and a loop over them would be
  // mispredicted at every entry.
  MUDG_INLINE void append(const std::uint32_t* masks, int first) {
#if defined(__AVX512F__)
    const __m512i of_entries = _mm512_load_si512(masks);
    const __m512i numbers = _mm512_add_epi32(_mm512_cvtps_epi32(_mm512_load_ps(kLaneIndex)), _mm512_set1_epi32(first));
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const __mmask16 touching = _mm512_test_epi32_mask(of_entries, _mm512_set1_epi32(1 << b));
      const __m128i packed = _mm512_cvtepi32_epi8(_mm512_maskz_compress_epi32(touching, numbers));
      _mm_storeu_si128(reinterpret_cast<__m128i*>(entries[b] + counts[b]), packed);
      counts[b] += __builtin_popcount(touching);
    }
#else
    unsigned touching[kBlocksPerTile];
    transpose_bits(masks, touching);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      int count = counts[b];
      for (unsigned left = touching[b]; left != 0; left &= left - 1)
        entries[b][count++] = static_cast<std::uint8_t>(first + __builtin_ctz(left));
      counts[b] = count;
    }
#endif
  }

 private:
#if !defined(__AVX512F__)
  // Bit i of touching[b] = bit b of masks[i].
  static MUDG_INLINE void transpose_bits(const std::uint32_t* masks, unsigned* touching) {
#if defined(__SSE2__)
    const auto* four = reinterpret_cast<const __m128i*>(masks);
    const __m128i low_byte = _mm_set1_epi32(0xff);
    __m128i halves[2];  // bytes of the low and of the high eight blocks
    for (int h = 0; h < 2; ++h) {
      __m128i parts[4];
      for (int k = 0; k < 4; ++k) parts[k] = _mm_and_si128(_mm_srli_epi32(_mm_load_si128(four + k), 8 * h), low_byte);
      halves[h] = _mm_packus_epi16(_mm_packs_epi32(parts[0], parts[1]), _mm_packs_epi32(parts[2], parts[3]));
    }
    for (int h = 0; h < 2; ++h) {
      for (int bit = 7; bit >= 0; --bit) {  // movemask reads the top bit of every byte
        touching[8 * h + bit] = static_cast<unsigned>(_mm_movemask_epi8(halves[h]));
        halves[h] = _mm_add_epi8(halves[h], halves[h]);
      }
    }
#else
    for (int b = 0; b < kBlocksPerTile; ++b) {
      touching[b] = 0;
      for (int i = 0; i < 16; ++i) touching[b] |= ((masks[i] >> b) & 1u) << i;
    }
#endif
  }
#endif
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

// Memory that will be needed soon. The requests are issued a few at a time, one helping per block of computation: all
// at once they would only wait for each other.
class Lookahead {
 public:
  // Splat rows of the list entries [begin, end).
  MUDG_INLINE void splats_of(const TileItem* begin, const TileItem* end) {
    splat_item_ = begin;
    splat_step_ = (end - begin + kBlocksPerTile - 1) / kBlocksPerTile;
    splat_end_ = end;
  }
  // Gradient records of the list entries [begin, end), to be written.
  MUDG_INLINE void records_of(const TileItem* begin, const TileItem* end) {
    record_item_ = begin;
    record_step_ = (end - begin + kBlocksPerTile - 1) / kBlocksPerTile;
    record_end_ = end;
  }
  // Pixels of a tile, one row per helping.
  MUDG_INLINE void pixels_of(const TilePlace& place) {
    offset_ = static_cast<std::size_t>(place.y) * place.width + place.x;
    rows_ = smaller(kTileSize, place.height - place.y);
    width_ = static_cast<std::size_t>(place.width);
  }

  template <bool kWrite, class Pointer>
  MUDG_INLINE void helping(const RasterState& state, const Pointer* planes, const float* alpha) {
    const TileItem* splat_stop = smaller(splat_item_ + splat_step_, splat_end_);
    for (; splat_item_ < splat_stop; ++splat_item_) {
      const float* row = state.splats + static_cast<std::size_t>(splat_item_->gaussian) * state.splat_stride;
      for (int at = 0; at < state.splat_stride; at += 16) __builtin_prefetch(row + at, 0, 2);
    }
    const TileItem* record_stop = smaller(record_item_ + record_step_, record_end_);
    for (; record_item_ < record_stop; ++record_item_) {
      const float* row = state.records + static_cast<std::size_t>(record_item_->record) * state.record_stride;
      __builtin_prefetch(row, 1, 2);
      __builtin_prefetch(row + state.record_stride - 1, 1, 2);
    }
    if (rows_ > 0) {
      for (int c = 0; c < state.channels; ++c) {
        if (kWrite || planes[c] != nullptr) __builtin_prefetch(planes[c] + offset_, kWrite, 2);
      }
      if (kWrite || alpha != nullptr) __builtin_prefetch(alpha + offset_, kWrite, 2);
      offset_ += width_;
      --rows_;
    }
  }

 private:
  const TileItem *splat_item_ = nullptr, *splat_end_ = nullptr, *record_item_ = nullptr, *record_end_ = nullptr;
  std::ptrdiff_t splat_step_ = 0, record_step_ = 0;
  std::size_t offset_ = 0, width_ = 0;
  int rows_ = 0;
};

// The splat rows of up to kChunk list entries side by side, and for every block the entries that touch it.
template <int kChannels>
struct Chunk {
  static constexpr int kRow = kFirstChannel + kChannels;
  alignas(64) float rows[kChunk * kRow];
  alignas(64) std::uint32_t masks[kChunk];
  BlockLists lists;

  MUDG_INLINE const float* row(int entry) const { return rows + entry * kRow; }

  MUDG_INLINE void gather(const RasterState& state, const TileItem* items, int size, unsigned wanted_blocks) {
    for (int i = 0; i < size; ++i) {
      const float* from = state.splats + static_cast<std::size_t>(items[i].gaussian) * state.splat_stride;
      float* to = rows + i * kRow;
      for (int k = 0; k < kRow; k += 4) std::memcpy(to + k, from + k, 16);
      masks[i] = items[i].blocks & wanted_blocks;
    }
    for (int i = size; i < round_up(size, 16); ++i) masks[i] = 0;
    std::memset(lists.counts, 0, sizeof lists.counts);
    for (int i = 0; i < size; i += 16) lists.append(masks + i, i);
    for (int b = 0; b < kBlocksPerTile; ++b)  // raw_alphas reads whole groups
      std::memset(lists.entries[b] + lists.counts[b], 0, kGroup);
  }
};

// Alphas before the cap of `count` entries on one block, 0 where they fall below 1/255; `out` has room for a whole
// number of groups. The forward and the backward pass both use it, so that they agree bit for bit on which pixels are touched.
//
// One alpha is a chain of some twenty dependent operations. Left in one loop with the blending it fills the processor's
// scheduler with waiting operations; several entries side by side, step by step, keep it busy.
MUDG_INLINE void raw_alphas(const float* rows, int row_stride, const std::uint8_t* entries, int count, Floats pixel_x,
                            Floats pixel_y, float (*out)[kPixelsPerBlock]) {
  const Floats cut = splat(-kLog2Of255);
  for (int j = 0; j < count; j += kGroup) {
    const float* row[kGroup];
    Floats dx[kGroup], dy[kGroup], power[kGroup];
    for (int k = 0; k < kGroup; ++k) row[k] = rows + entries[j + k] * row_stride;
    for (int k = 0; k < kGroup; ++k) dy[k] = splat(row[k][kMeanY]) - pixel_y;
    for (int k = 0; k < kGroup; ++k) dx[k] = splat(row[k][kMeanX]) - pixel_x;
    for (int k = 0; k < kGroup; ++k) dx[k] = mul_add(splat(row[k][kShear]), dy[k], dx[k]);
    for (int k = 0; k < kGroup; ++k) dy[k] = (splat(row[k][kHeight]) * dy[k]) * dy[k];
    for (int k = 0; k < kGroup; ++k) dy[k] = mul_add(splat(row[k][kStretch]) * dx[k], dx[k], dy[k]);
    for (int k = 0; k < kGroup; ++k) power[k] = splat(row[k][kLogOpacity]) - dy[k];
    Floats alpha[kGroup];
    exp2_group(power, alpha);
    for (int k = 0; k < kGroup; ++k) store(out[j + k], keep(power[k] >= cut, alpha[k]));
  }
}

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
