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

MUDG_INLINE int emit_entry(int tile, unsigned blocks, TileEntry* out, std::int32_t* tile_counts) {
  ++tile_counts[tile];
  *out = {tile, blocks};
  return 1;
}

// A footprint of a few blocks: its rectangle is tight enough.
MUDG_INLINE int emit_rectangle(const Footprint& f, int tiles_x, TileEntry* out, std::int32_t* tile_counts) {
  const int left = f.left >> 2, right = f.right >> 2, top = f.top >> 2, bottom = f.bottom >> 2;  // blocks
  int written = 0;
  for (int ty = top >> 2; ty <= bottom >> 2; ++ty) {
    const int row0 = larger(top - ty * 4, 0), row1 = smaller(bottom - ty * 4, 3);
    const unsigned rows = ((1u << (4 * (row1 + 1))) - 1) & ~((1u << (4 * row0)) - 1);
    for (int tx = left >> 2; tx <= right >> 2; ++tx) {
      const int column0 = larger(left - tx * 4, 0), column1 = smaller(right - tx * 4, 3);
      const unsigned columns = ((2u << column1) - 1) & ~((1u << column0) - 1);
      written += emit_entry(ty * tiles_x + tx, (columns * 0x1111u) & rows, out + written, tile_counts);
    }
  }
  return written;
}

// First and last block column that the ellipse reaches in each of 16 consecutive block rows, starting at pixel row
// `y0`.
MUDG_INLINE void strip_extents(const Footprint& f, int y0, int* first_column, int* last_column) {
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
  store_int(first_column, truncate(select(reached, floor_of(first * quarter), splat(1e6f))));
  store_int(last_column, truncate(select(reached, floor_of(last * quarter), splat(-1.0f))));
}

// Writes one entry per touched tile and returns how many. `out` has room for the whole rectangle plus one.
MUDG_INLINE int emit_footprint(const Footprint& f, int tiles_x, TileEntry* out, std::int32_t* tile_counts) {
  const bool small = (f.right >> 2) - (f.left >> 2) < 2 || (f.bottom >> 2) == (f.top >> 2);
  if (small) return emit_rectangle(f, tiles_x, out, tile_counts);
  int written = 0;
  for (int ty = f.top >> 4; ty <= f.bottom >> 4; ty += 4) {
    alignas(64) int first_column[kLanes], last_column[kLanes];
    strip_extents(f, ty * kTileSize, first_column, last_column);
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
          const int touched = blocks != 0;
          out[written] = {tile, blocks};
          tile_counts[tile] += touched;
          written += touched;
        }
      }
    }
  }
  return written;
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
