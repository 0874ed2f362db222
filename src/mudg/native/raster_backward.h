// Back-to-front gradient of one tile. For every block and chunk: first the per-pixel quantities (blending weight and
// gradient of sigma) of all entries, then two small matrix products that turn them into colour gradients and moments.
// Each entry of the tile ends as one record; records are summed per Gaussian afterwards, without atomics and in a fixed
// order.
#pragma once

#include "raster_blend.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// For every pixel of a tile, block by block: 1, x, y, x^2, x y, y^2 about the tile's centre, padded to 8.
constexpr int kMomentColumns = 8;
struct MomentBasis {
  alignas(64) float rows[kBlocksPerTile][kPixelsPerBlock][kMomentColumns];
  constexpr MomentBasis() : rows() {
    for (int b = 0; b < kBlocksPerTile; ++b) {
      for (int l = 0; l < kPixelsPerBlock; ++l) {
        const float x = static_cast<float>((b & 3) * 4 + (l & 3)) - 7.5f,
                    y = static_cast<float>((b >> 2) * 4 + (l >> 2)) - 7.5f;
        const float row[kMomentColumns] = {1.0f, x, y, x * x, x * y, y * y, 0.0f, 0.0f};
        for (int k = 0; k < kMomentColumns; ++k) rows[b][l][k] = row[k];
      }
    }
  }
};
constexpr MomentBasis kMomentBasis;

// out[entries[j]] += sum over pixels of weights[j][pixel] * rows[pixel], for j < count. Rows of kColumns floats.
template <class Row, int kColumns>
MUDG_INLINE void accumulate_rows(const float (*rows)[kColumns], const float (*weights)[kPixelsPerBlock],
                                 const std::uint8_t* entries, int count, float* out, int out_stride) {
  for (int column = 0; column < kColumns; column += Row::kWidth) {
    for (int first = 0; first < kPixelsPerBlock; first += Row::kRows) {
      Row held[Row::kRows];
      for (int l = 0; l < Row::kRows; ++l) held[l] = Row::load_row(&rows[first + l][column]);
      for (int j = 0; j < count; ++j) {
        const float* weight = weights[j] + first;
        float* at = out + entries[j] * out_stride + column;
        Row even = Row::load_row(at), odd = Row::product(weight[1], held[1]);
        even.add_product(weight[0], held[0]);
        for (int l = 2; l < Row::kRows; l += 2) {
          even.add_product(weight[l], held[l]);
          odd.add_product(weight[l + 1], held[l + 1]);
        }
        even.plus(odd).store_row(at);
      }
    }
  }
}

MUDG_INLINE void mark_untouched(float* record) { std::memcpy(record, &kNoContribution, sizeof kNoContribution); }

template <int kChannels, bool kAbsolute>
struct BackwardTile {
  static constexpr int kColumns = round_up(kChannels, WideRow::kWidth);
  static constexpr int kRecord = kRecordChannels + kColumns;

  alignas(64) float upstream[kBlocksPerTile][kChannels][kPixelsPerBlock];      // image gradient, by channel
  alignas(64) float upstream_rows[kBlocksPerTile][kPixelsPerBlock][kColumns];  // the same, by pixel
  alignas(64) float upstream_alpha[kBlocksPerTile][kPixelsPerBlock];  // gradient of log(final transmittance), negated
  alignas(64) float transmittance[kBlocksPerTile][kPixelsPerBlock];   // in front of what has been undone so far
  alignas(64) float behind[kBlocksPerTile][kPixelsPerBlock];          // light from behind, times the image gradient
  int block_last[kBlocksPerTile];
  alignas(64) float records[kChunk * kRecord];
  alignas(64) float alphas[kChunk + kGroup][kPixelsPerBlock];  // of one block's entries, and what follows from them
  alignas(64) float products[kChunk + kGroup][kPixelsPerBlock];
  alignas(64) float weights[kChunk][kPixelsPerBlock];
  alignas(64) float sigma_gradient[kChunk][kPixelsPerBlock];
  Chunk<kChannels> chunk;

  // Loads the image gradients of one block (null planes count as zero); adds to the background's gradient.
  MUDG_INLINE void load_block(const RasterState& state, const TilePlace& place, int b, const float* const* planes,
                              const float* alpha_plane, const float* final, float* background_gradient) {
    const int x0 = place.block_x(b), y0 = place.block_y(b);
    const std::size_t stride = static_cast<std::size_t>(place.width);
    const bool whole = x0 + kBlockSize <= place.width && y0 + kBlockSize <= place.height;
    const auto load_plane = [&](const float* plane, float* to) {
      if (plane == nullptr) {
        std::memset(to, 0, kPixelsPerBlock * sizeof(float));
      } else if (whole) {
        for (int r = 0; r < kBlockSize; ++r) std::memcpy(to + 4 * r, plane + (y0 + r) * stride + x0, 16);
      } else {
        for (int l = 0; l < kPixelsPerBlock; ++l) {
          const int x = x0 + (l & 3), y = y0 + (l >> 2);
          to[l] = x < place.width && y < place.height ? plane[y * stride + x] : 0.0f;
        }
      }
    };
    for (int c = 0; c < kChannels; ++c) load_plane(c < state.channels ? planes[c] : nullptr, upstream[b][c]);
    for (int l = 0; l < kPixelsPerBlock; ++l) {
      for (int c = 0; c < kChannels; ++c) upstream_rows[b][l][c] = upstream[b][c][l];
      for (int c = kChannels; c < kColumns; ++c) upstream_rows[b][l][c] = 0.0f;
    }
    // alpha = 1 - T and the image holds T * background, so the gradient of T is background . upstream - upstream_alpha.
    load_plane(alpha_plane, upstream_alpha[b]);
    const Floats left = load_unaligned(final);
    Floats of_alpha = load(upstream_alpha[b]);
    for (int c = 0; c < 3; ++c) {
      const Floats channel = load(upstream[b][c]);
      of_alpha = neg_mul_add(splat(state.scene.background[c]), channel, of_alpha);
      background_gradient[c] += sum(left * channel);
    }
    store(upstream_alpha[b], of_alpha * left);
  }

  // Returns the position of the last entry of the tile that contributed anywhere, -1 if none did.
  MUDG_INLINE int start(const RasterState& state, const TilePlace& place, const float* const* planes,
                        const float* alpha_plane, const float* final, const std::int32_t* last,
                        float* background_gradient, unsigned& blocks) {
    int tile_last = -1;
    blocks = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) {
      int position = -1;
      for (int l = 0; l < kPixelsPerBlock; ++l) position = larger(position, last[b * kPixelsPerBlock + l]);
      block_last[b] = position;
      if (place.block_x(b) >= place.width || place.block_y(b) >= place.height) continue;
      load_block(state, place, b, planes, alpha_plane, final + b * kPixelsPerBlock, background_gradient);
      if (position < 0) continue;
      blocks |= 1u << b;
      tile_last = larger(tile_last, position);
      store(transmittance[b], load_unaligned(final + b * kPixelsPerBlock));
      store(behind[b], splat(0.0f));
    }
    return tile_last;
  }

  // products[j] = colour of the entry . image gradient, for every pixel of the block.
  MUDG_INLINE void image_products(int b, const std::uint8_t* entries, int count) {
    const float (*image)[kPixelsPerBlock] = upstream[b];
    for (int j = 0; j < count; j += kGroup) {
      const float* channel[kGroup];
      Floats even[kGroup], odd[kGroup];
      for (int k = 0; k < kGroup; ++k) channel[k] = chunk.row(entries[j + k]) + kFirstChannel;
      for (int k = 0; k < kGroup; ++k) even[k] = splat(channel[k][0]) * load(image[0]);
      for (int k = 0; k < kGroup; ++k) odd[k] = splat(channel[k][1]) * load(image[1]);
      for (int c = 2; c < kChannels; c += 2) {
        for (int k = 0; k < kGroup; ++k) even[k] = mul_add(splat(channel[k][c]), load(image[c]), even[k]);
        for (int k = 0; k < kGroup; ++k) odd[k] = mul_add(splat(channel[k][c + 1]), load(image[c + 1]), odd[k]);
      }
      for (int k = 0; k < kGroup; ++k) store(products[j + k], even[k] + odd[k]);
    }
  }

  // Sums of the absolute values of every pixel's part of the gradient of the projected mean.
  MUDG_INLINE void add_absolute(const std::uint8_t* entries, int count, Floats pixel_x, Floats pixel_y) {
    for (int j = 0; j < count; ++j) {
      const float* row = chunk.row(entries[j]);
      const Floats dx = splat(row[kMeanX]) - pixel_x, dy = splat(row[kMeanY]) - pixel_y;
      const Floats of_sigma = load(sigma_gradient[j]);
      const float a = row[kStretch] * (2.0f * kLn2), bb = row[kShear] * a;
      const float c = row[kHeight] * (2.0f * kLn2) + row[kShear] * bb;
      float* record = records + entries[j] * kRecord;
      record[kAbsX] += sum(abs_of(of_sigma * mul_add(splat(a), dx, splat(bb) * dy)));
      record[kAbsY] += sum(abs_of(of_sigma * mul_add(splat(bb), dx, splat(c) * dy)));
    }
  }

  MUDG_INLINE void undo_block(int b, int base, const TilePlace& place, const std::int32_t* last, Floats cap) {
    int count = chunk.lists.counts[b];
    const std::uint8_t* entries = chunk.lists.entries[b];
    while (count > 0 && base + entries[count - 1] > block_last[b]) --count;
    if (count == 0) return;
    const Floats pixel_x = place.pixel_x(b), pixel_y = place.pixel_y(b), one = splat(1.0f);
    const Floats of_alpha = load(upstream_alpha[b]);
    const Ints last_position = load_int(last + b * kPixelsPerBlock);
    raw_alphas(chunk.rows, chunk.kRow, entries, count, pixel_x, pixel_y, alphas);
    image_products(b, entries, count);
    Floats before = load(transmittance[b]), light = load(behind[b]);
    for (int j = count - 1; j >= 0; --j) {
      const Mask touched = at_least(last_position, splat_int(base + entries[j]));
      const Floats raw = keep(touched, load(alphas[j])), own = load(products[j]);
      const Floats alpha = min_of(raw, cap);
      const Floats inv_pass = reciprocal(one - alpha);
      before = before * inv_pass;
      const Floats weight = alpha * before;
      // d loss / d alpha = T own - (light - of_alpha) / (1 - alpha); sigma lowers alpha, hence the opposite sign.
      const Floats minus_alpha_gradient = neg_mul_add(before, own, inv_pass * (light - of_alpha));
      light = mul_add(weight, own, light);
      store(weights[j], weight);
      store(sigma_gradient[j], keep(raw <= cap, raw * minus_alpha_gradient));
    }
    if (kAbsolute) add_absolute(entries, count, pixel_x, pixel_y);
    store(transmittance[b], before);
    store(behind[b], light);
    accumulate_rows<WideRow, kColumns>(upstream_rows[b], weights, entries, count, records + kRecordChannels, kRecord);
    accumulate_rows<NarrowRow, kMomentColumns>(kMomentBasis.rows[b], sigma_gradient, entries, count, records + kMoments,
                                               kRecord);
  }
};

// Brings the next tile's image gradients closer while this one is worked on.
MUDG_INLINE void prefetch_tile(const RasterState& state, int tile, const float* const* planes,
                               const float* alpha_plane) {
  if (tile >= state.tiles_x * state.tiles_y) return;
  const TilePlace place(state, tile);
  const int rows = smaller(kTileSize, place.height - place.y);
  for (int y = 0; y < rows; ++y) {
    const std::size_t at = static_cast<std::size_t>(place.y + y) * place.width + place.x;
    for (int c = 0; c < state.channels; ++c) {
      if (planes[c] != nullptr) __builtin_prefetch(planes[c] + at, 0, 2);
    }
    if (alpha_plane != nullptr) __builtin_prefetch(alpha_plane + at, 0, 2);
  }
}

template <int kChannels, bool kAbsolute>
void undo_tile(RasterState& state, int tile, const float* const* planes, const float* alpha_plane) {
  using Work = BackwardTile<kChannels, kAbsolute>;
  const TilePlace place(state, tile);
  const TileItem* items = state.items + state.tile_start[tile];
  const int count = state.tile_start[tile + 1] - state.tile_start[tile];
  const float* final = state.final_transmittance + static_cast<std::size_t>(tile) * kPixelsPerTile;
  const std::int32_t* last = state.last_item + static_cast<std::size_t>(tile) * kPixelsPerTile;
  const std::size_t stride = static_cast<std::size_t>(state.record_stride);
  Work work;
  unsigned blocks = 0;
  float background[4] = {};
  const int tile_last = work.start(state, place, planes, alpha_plane, final, last, background, blocks);
  std::memcpy(state.tile_background + static_cast<std::size_t>(tile) * 4, background, sizeof background);
  for (int i = tile_last + 1; i < count; ++i) mark_untouched(state.records + items[i].record * stride);
  prefetch_tile(state, tile + 1, planes, alpha_plane);
  if (tile_last < 0) return;
  const Floats cap = splat(state.scene.alpha_max);
  for (int base = tile_last / kChunk * kChunk; base >= 0; base -= kChunk) {
    const int size = smaller(kChunk, tile_last + 1 - base);
    work.chunk.gather(state, items + base, size, blocks);
    std::memset(work.records, 0, sizeof(float) * Work::kRecord * size);
    for (int i = 0; i < size; ++i) {
      const float* target = state.records + items[base + i].record * stride;
      __builtin_prefetch(target, 1, 2);
      __builtin_prefetch(target + stride - 1, 1, 2);
    }
    for (unsigned left = blocks; left != 0; left &= left - 1)
      work.undo_block(__builtin_ctz(left), base, place, last, cap);
    for (int i = 0; i < size; ++i) {
      float* target = state.records + items[base + i].record * stride;
      const float* from = work.records + i * Work::kRecord;
      for (int k = 0; k < kRecordChannels + kChannels; k += 4) std::memcpy(target + k, from + k, 16);
    }
  }
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
