// Which tiles, and which 4x4 blocks in them, an ellipse touches. Conservative: the mask may hold a block too many,
// never one too few, because a pixel's own alpha test decides in the end.
#pragma once

#include "raster_types.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// The ellipse stretch * ((x + shear * y)^2 + ratio * y^2) <= level around (mean_x, mean_y), cut off at alpha = 1/255,
// and the rectangle of pixels (inclusive) that holds it.
struct Footprint {
  float mean_x, mean_y;
  float shear;        // B / A of the conic
  float ratio;        // (C - B^2 / A) / A
  float half_width2;  // level / A: square of the half width on the row through the centre
  float extreme_y;    // y of the rightmost point, relative to the mean
  int left, right, top, bottom;
};

// A footprint of a few blocks: its rectangle is tight enough.
MUDG_INLINE int emit_rectangle(const Footprint& f, int tiles_x, TileEntry* out) {
  const int left = f.left >> 2, right = f.right >> 2, top = f.top >> 2, bottom = f.bottom >> 2;  // blocks
  int written = 0;
  for (int ty = top >> 2; ty <= bottom >> 2; ++ty) {
    const int row0 = larger(top - ty * 4, 0), row1 = smaller(bottom - ty * 4, 3);
    const unsigned rows = ((1u << (4 * (row1 + 1))) - 1) & ~((1u << (4 * row0)) - 1);
    for (int tx = left >> 2; tx <= right >> 2; ++tx) {
      const int column0 = larger(left - tx * 4, 0), column1 = smaller(right - tx * 4, 3);
      const unsigned columns = ((2u << column1) - 1) & ~((1u << column0) - 1);
      out[written++] = {ty * tiles_x + tx, (columns * 0x1111u) & rows};
    }
  }
  return written;
}

// First and last block column that the ellipse reaches in each of 16 consecutive block rows, starting at pixel row
// `y0`.
MUDG_INLINE void strip_extents(const Footprint& f, int y0, Ints& first_column, Ints& last_column) {
  constexpr float kMargin = 0.01f;  // pixels
  const Floats row = mul_add(load(kLaneIndex), splat(4.0f), splat(static_cast<float>(y0)));
  Floats upper = max_of(row, splat(static_cast<float>(f.top)));
  Floats lower = min_of(row + splat(3.0f), splat(static_cast<float>(f.bottom)));
  Mask reached = upper <= lower;
  upper = upper + splat(0.5f - f.mean_y);
  lower = lower + splat(0.5f - f.mean_y);
  const auto half_width = [&](Floats y) {
    return sqrt_of(max_of(neg_mul_add(splat(f.ratio) * y, y, splat(f.half_width2)), splat(0.0f)));
  };
  // Within the strip the ellipse is widest where its boundary's extreme point is, or at the nearer edge of the strip.
  const Floats y_right = min_of(max_of(splat(f.extreme_y), upper), lower);
  const Floats y_left = min_of(max_of(splat(-f.extreme_y), upper), lower);
  const Floats x_right = neg_mul_add(splat(f.shear), y_right, half_width(y_right));
  const Floats x_left = neg_mul_add(splat(f.shear), y_left, splat(0.0f) - half_width(y_left));
  const Floats last = min_of(floor_of(x_right + splat(f.mean_x + kMargin - 0.5f)), splat(static_cast<float>(f.right)));
  const Floats first = max_of(ceil_of(x_left + splat(f.mean_x - kMargin - 0.5f)), splat(static_cast<float>(f.left)));
  reached = reached & (first <= last);
  const Floats quarter = splat(0.25f);
  first_column = truncate(select(reached, floor_of(first * quarter), splat(1e6f)));
  last_column = truncate(select(reached, floor_of(last * quarter), splat(-1.0f)));
}

#if defined(__AVX512F__)
// A footprint within 4 x 4 tiles, without a branch that depends on its shape. Lane 4 q + t of the result stands for the
// tile in row q and column t.
MUDG_INLINE int emit_sixteen_tiles(const Footprint& f, bool whole_rectangle, int tiles_x, TileEntry* out) {
  const int tx = f.left >> 4, ty = f.top >> 4;
  Ints first, last;
  strip_extents(f, ty * kTileSize, first, last);
  const __m512i lane = _mm512_cvtps_epi32(_mm512_load_ps(kLaneIndex));
  if (whole_rectangle) {
    const __m512i strips = _mm512_add_epi32(lane, _mm512_set1_epi32(ty * 4));
    const __mmask16 inside = _mm512_cmpge_epi32_mask(strips, _mm512_set1_epi32(f.top >> 2)) &
                             _mm512_cmple_epi32_mask(strips, _mm512_set1_epi32(f.bottom >> 2));
    first.v = _mm512_set1_epi32(f.left >> 2);
    last.v = _mm512_mask_set1_epi32(_mm512_set1_epi32(-1), inside, f.right >> 2);
  }
  const __m512i left = _mm512_set1_epi32(tx * 4), one = _mm512_set1_epi32(1);
  // Bit c: block column c of the strip is reached. A shift by 32 or more gives 0.
  const __m512i high = _mm512_sllv_epi32(_mm512_add_epi32(one, one), _mm512_sub_epi32(last.v, left));
  const __m512i low = _mm512_sllv_epi32(one, _mm512_sub_epi32(first.v, left));
  const __mmask16 reached = _mm512_cmpge_epi32_mask(last.v, first.v);
  const __m512i columns = _mm512_maskz_sub_epi32(reached, high, low);
  const __m512i row = _mm512_srli_epi32(lane, 2), column = _mm512_and_si512(lane, _mm512_set1_epi32(3));
  const __m512i shift = _mm512_slli_epi32(column, 2), strip = _mm512_slli_epi32(row, 2);
  __m512i blocks = _mm512_setzero_si512();
  for (int k = 0; k < 4; ++k) {
    const __m512i of_strip = _mm512_permutexvar_epi32(_mm512_add_epi32(strip, _mm512_set1_epi32(k)), columns);
    const __m512i nibble = _mm512_and_si512(_mm512_srlv_epi32(of_strip, shift), _mm512_set1_epi32(15));
    blocks = _mm512_or_si512(blocks, _mm512_sllv_epi32(nibble, _mm512_set1_epi32(4 * k)));
  }
  const __m512i tile = _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(tiles_x)),
                                        _mm512_add_epi32(column, _mm512_set1_epi32(ty * tiles_x + tx)));
  const __mmask16 touched = _mm512_test_epi32_mask(blocks, blocks);
  const __m512i tiles = _mm512_maskz_compress_epi32(touched, tile);
  const __m512i masks = _mm512_maskz_compress_epi32(touched, blocks);
  const __m512i half = _mm512_srli_epi32(lane, 1);
  const __m512i pairs = _mm512_mask_add_epi32(half, 0xaaaa, half, _mm512_set1_epi32(16));  // 0 16 1 17 2 18 ..
  const __m512i later = _mm512_add_epi32(pairs, _mm512_set1_epi32(8));
  _mm512_storeu_si512(out, _mm512_permutex2var_epi32(tiles, pairs, masks));
  _mm512_storeu_si512(out + 8, _mm512_permutex2var_epi32(tiles, later, masks));
  return __builtin_popcount(touched);
}
#endif

// Writes one entry per touched tile and returns how many. `out` has room for the whole rectangle plus one, and for 16.
MUDG_INLINE int emit_footprint(const Footprint& f, int tiles_x, TileEntry* out) {
  const bool small = (f.right >> 2) - (f.left >> 2) < 2 || (f.bottom >> 2) == (f.top >> 2);
#if defined(__AVX512F__)
  if ((f.right >> 4) - (f.left >> 4) < 4 && (f.bottom >> 4) - (f.top >> 4) < 4)
    return emit_sixteen_tiles(f, small, tiles_x, out);
#endif
  if (small) return emit_rectangle(f, tiles_x, out);
  int written = 0;
  for (int ty = f.top >> 4; ty <= f.bottom >> 4; ty += 4) {
    alignas(64) int first_column[kLanes], last_column[kLanes];
    Ints first_columns, last_columns;
    strip_extents(f, ty * kTileSize, first_columns, last_columns);
    store_int(first_column, first_columns);
    store_int(last_column, last_columns);
    for (int q = 0; q < 4 && ty + q <= f.bottom >> 4; ++q) {
      const int *first = first_column + 4 * q, *last = last_column + 4 * q;
      const int leftmost = smaller(smaller(first[0], first[1]), smaller(first[2], first[3]));
      const int rightmost = larger(larger(last[0], last[1]), larger(last[2], last[3]));
      if (rightmost < 0) continue;
      for (int base = leftmost >> 2; base <= rightmost >> 2; base += 16) {  // 16 tiles = 64 block columns at a time
        std::uint64_t columns[4];
        for (int k = 0; k < 4; ++k) {
          const int low = larger(first[k] - base * 4, 0), high = smaller(last[k] - base * 4, 63);
          columns[k] = low <= high ? (((2ull << high) - 1) & ~((1ull << low) - 1)) : 0;
        }
        const int end = smaller(rightmost >> 2, base + 15);
        for (int tx = base; tx <= end; ++tx) {
          unsigned blocks = 0;
          for (int k = 0; k < 4; ++k) {
            blocks |= static_cast<unsigned>(columns[k] & 15) << (4 * k);
            columns[k] >>= 4;
          }
          // Always written, counted only if anything is set: cheaper than a branch.
          const int tile = (ty + q) * tiles_x + tx;
          out[written] = {tile, blocks};
          written += blocks != 0;
        }
      }
    }
  }
  return written;
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
