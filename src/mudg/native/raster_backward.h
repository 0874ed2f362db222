// Back-to-front gradient of one tile. For every block and chunk: first the per-pixel quantities (blending weight and
// gradient of sigma) of all entries, then two small matrix products that turn them into colour gradients and moments.
// Each entry of the tile ends as one record; records are summed per Gaussian afterwards, without atomics and in a fixed
// order.
#pragma once

#include "raster_blend.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

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

#if defined(__AVX512F__)
// The moments of sixteen entries at a time, one entry per lane: fewer operations than the matrix product, because the
// powers of x and y are the same for every row and column of pixels.
struct FourQuads {
  __m512 v[4];
};

// v[i], lane e = rows[e][at + i] for sixteen rows.
MUDG_INLINE FourQuads transposed_quads(const float (*rows)[kPixelsPerBlock], int at) {
  __m512 r[4];
  for (int k = 0; k < 4; ++k) {
    __m512 joined = _mm512_castps128_ps512(_mm_load_ps(&rows[k][at]));
    joined = _mm512_mask_broadcast_f32x4(joined, 0x00f0, _mm_load_ps(&rows[4 + k][at]));
    joined = _mm512_mask_broadcast_f32x4(joined, 0x0f00, _mm_load_ps(&rows[8 + k][at]));
    r[k] = _mm512_mask_broadcast_f32x4(joined, 0xf000, _mm_load_ps(&rows[12 + k][at]));
  }
  const __m512 a = _mm512_unpacklo_ps(r[0], r[1]), b = _mm512_unpackhi_ps(r[0], r[1]);
  const __m512 c = _mm512_unpacklo_ps(r[2], r[3]), d = _mm512_unpackhi_ps(r[2], r[3]);
  return {{_mm512_shuffle_ps(a, c, 0x44), _mm512_shuffle_ps(a, c, 0xee), _mm512_shuffle_ps(b, d, 0x44),
           _mm512_shuffle_ps(b, d, 0xee)}};
}

// out[k][m] = f[0..3] of lane 4 m + k.
MUDG_INLINE void store_quads(const Floats* f, float (*out)[4][4]) {
  const __m512 a = _mm512_unpacklo_ps(f[0].v, f[1].v), b = _mm512_unpackhi_ps(f[0].v, f[1].v);
  const __m512 c = _mm512_unpacklo_ps(f[2].v, f[3].v), d = _mm512_unpackhi_ps(f[2].v, f[3].v);
  _mm512_store_ps(out[0], _mm512_shuffle_ps(a, c, 0x44));
  _mm512_store_ps(out[1], _mm512_shuffle_ps(a, c, 0xee));
  _mm512_store_ps(out[2], _mm512_shuffle_ps(b, d, 0x44));
  _mm512_store_ps(out[3], _mm512_shuffle_ps(b, d, 0xee));
}

// Adds the moments of block b's entries to their records. `weights` has room for a multiple of sixteen.
MUDG_INLINE void accumulate_moments(int b, const float (*weights)[kPixelsPerBlock], const std::uint8_t* entries,
                                    int count, float* records, int record_stride) {
  const Floats near = splat(0.5f), far = splat(1.5f), near2 = splat(0.25f), far2 = splat(2.25f);
  const Floats cx = splat(static_cast<float>((b & 3) * 4 - 6)), cy = splat(static_cast<float>((b >> 2) * 4 - 6));
  for (int first = 0; first < count; first += 16) {
    Floats mass[4], x[4], xx[4];  // by row of pixels, about the block's centre
    for (int q = 0; q < 4; ++q) {
      const FourQuads p = transposed_quads(weights + first, 4 * q);
      const Floats p0 = {p.v[0]}, p1 = {p.v[1]}, p2 = {p.v[2]}, p3 = {p.v[3]};
      const Floats outer = p0 + p3, inner = p1 + p2;
      mass[q] = outer + inner;
      x[q] = mul_add(far, p3 - p0, near * (p2 - p1));
      xx[q] = mul_add(far2, outer, near2 * inner);
    }
    const Floats m = (mass[0] + mass[3]) + (mass[1] + mass[2]);
    const Floats mx = (x[0] + x[3]) + (x[1] + x[2]);
    const Floats my = mul_add(far, mass[3] - mass[0], near * (mass[2] - mass[1]));
    const Floats mxx = (xx[0] + xx[3]) + (xx[1] + xx[2]);
    const Floats mxy = mul_add(far, x[3] - x[0], near * (x[2] - x[1]));
    const Floats myy = mul_add(far2, mass[0] + mass[3], near2 * (mass[1] + mass[2]));
    // Moved to the tile's centre.
    Floats f[8];
    f[0] = m;
    f[1] = mul_add(cx, m, mx);
    f[2] = mul_add(cy, m, my);
    f[3] = mul_add(cx, mx + f[1], mxx);
    f[4] = mul_add(cx, f[2], mul_add(cy, mx, mxy));
    f[5] = mul_add(cy, my + f[2], myy);
    f[6] = f[7] = splat(0.0f);
    alignas(64) float low[4][4][4], high[4][4][4];
    store_quads(f, low);
    store_quads(f + 4, high);
    const int size = smaller(16, count - first);
    for (int e = 0; e < size; ++e) {
      float* at = records + entries[first + e] * record_stride;
      const __m256 row = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_load_ps(low[e & 3][e >> 2])),
                                              _mm_load_ps(high[e & 3][e >> 2]), 1);
      _mm256_storeu_ps(at, _mm256_add_ps(_mm256_loadu_ps(at), row));
    }
  }
}
#else
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

MUDG_INLINE void accumulate_moments(int b, const float (*weights)[kPixelsPerBlock], const std::uint8_t* entries,
                                    int count, float* records, int record_stride) {
  accumulate_rows<NarrowRow, kMomentColumns>(kMomentBasis.rows[b], weights, entries, count, records, record_stride);
}
#endif

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
  alignas(64) float sigma_gradient[round_up(kChunk, 16)][kPixelsPerBlock];
  Chunk<kChannels> chunk;

  // Loads the image gradients of one block (null planes count as zero).
  MUDG_INLINE void load_block(const RasterState& state, const TilePlace& place, int b, const float* const* planes,
                              const float* alpha_plane, const float* final, const float* depth) {
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
    load_plane(alpha_plane, upstream_alpha[b]);
    // The depth image is accumulated depth over alpha; from here on channel 3 is the gradient of the accumulated depth.
    const Floats left = load_unaligned(final), alpha = splat(1.0f) - left;
    const Floats of_sum =
        keep(alpha > splat(kLeastAlpha), load(upstream[b][3]) / max_of(alpha, splat(kLeastAlpha)));
    store(upstream[b][3], of_sum);
    for (int l = 0; l < kPixelsPerBlock; ++l) {
      for (int c = 0; c < kChannels; ++c) upstream_rows[b][l][c] = upstream[b][c][l];
      for (int c = kChannels; c < kColumns; ++c) upstream_rows[b][l][c] = 0.0f;
    }
    // alpha = 1 - T, so the gradient of T is that of alpha, negated.
    store(upstream_alpha[b], neg_mul_add(of_sum, load_unaligned(depth), load(upstream_alpha[b])) * left);
  }

  // Returns the position of the last entry of the tile that contributed anywhere, -1 if none did.
  MUDG_INLINE int start(const RasterState& state, const TilePlace& place, const float* const* planes,
                        const float* alpha_plane, const float* final, const float* depth, const std::int32_t* last,
                        unsigned& blocks) {
    int tile_last = -1;
    blocks = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) {
      int position = -1;
      for (int l = 0; l < kPixelsPerBlock; ++l) position = larger(position, last[b * kPixelsPerBlock + l]);
      block_last[b] = position;
      if (place.block_x(b) >= place.width || place.block_y(b) >= place.height) continue;
      load_block(state, place, b, planes, alpha_plane, final + b * kPixelsPerBlock, depth + b * kPixelsPerBlock);
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
    accumulate_moments(b, sigma_gradient, entries, count, records + kMoments, kRecord);
  }
};

template <int kChannels, bool kAbsolute>
void undo_tile(RasterState& state, int tile, const float* const* planes, const float* alpha_plane) {
  using Work = BackwardTile<kChannels, kAbsolute>;
  const TilePlace place(state, tile);
  const TileItem* items = state.items + state.tile_start[tile];
  const int count = state.tile_start[tile + 1] - state.tile_start[tile];
  const float* final = state.final_transmittance + static_cast<std::size_t>(tile) * kPixelsPerTile;
  const float* depth = state.expected_depth + static_cast<std::size_t>(tile) * kPixelsPerTile;
  const std::int32_t* last = state.last_item + static_cast<std::size_t>(tile) * kPixelsPerTile;
  const std::size_t stride = static_cast<std::size_t>(state.record_stride);
  Work work;
  unsigned blocks = 0;
  const int tile_last = work.start(state, place, planes, alpha_plane, final, depth, last, blocks);
  for (int i = tile_last + 1; i < count; ++i) mark_untouched(state.records + items[i].record * stride);
  if (tile_last < 0) return;
  const Floats cap = splat(state.scene.alpha_max);
  Lookahead ahead;
  const bool is_last = tile + 1 == state.tiles_x * state.tiles_y;
  if (!is_last) ahead.pixels_of(TilePlace(state, tile + 1));
  const int next_end = is_last ? count : count + (state.tile_start[tile + 2] - state.tile_start[tile + 1]);
  for (int base = tile_last / kChunk * kChunk; base >= 0; base -= kChunk) {
    const int size = smaller(kChunk, tile_last + 1 - base);
    work.chunk.gather(state, items + base, size, blocks);
    std::memset(work.records, 0, sizeof(float) * Work::kRecord * size);
    ahead.records_of(items + base, items + base + size);
    if (base > 0) {
      ahead.splats_of(items + base - kChunk, items + base);
    } else {  // the end of the next tile's list comes next
      ahead.splats_of(items + larger(count, next_end - kChunk), items + next_end);
    }
    for (unsigned left = blocks; left != 0; left &= left - 1) {
      ahead.helping<false>(state, planes, alpha_plane);
      work.undo_block(__builtin_ctz(left), base, place, last, cap);
    }
    for (int i = 0; i < size; ++i) {
      float* target = state.records + items[base + i].record * stride;
      const float* from = work.records + i * Work::kRecord;
      for (int k = 0; k < kRecordChannels + kChannels; k += 4) std::memcpy(target + k, from + k, 16);
    }
  }
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
