// Front-to-back blending of one tile. The accumulators of a block stay in registers for a chunk of the list.
#pragma once

#include "raster_blend.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

template <int kChannels>
struct ForwardTile {
  alignas(64) float color[kBlocksPerTile][kChannels][kPixelsPerBlock];
  alignas(64) float running[kBlocksPerTile][kPixelsPerBlock];  // transmittance, 0 once the pixel is finished
  alignas(64) float final[kBlocksPerTile][kPixelsPerBlock];    // transmittance behind the last entry blended
  alignas(64) int last[kBlocksPerTile][kPixelsPerBlock];       // last list position before the pixel was finished
  alignas(64) float alphas[kBatch][kPixelsPerBlock];
  Chunk<kChannels> chunk;

  // Returns the blocks that lie in the image at least in part.
  MUDG_INLINE unsigned start(const TilePlace& place) {
    unsigned blocks = 0;
    std::memset(color, 0, sizeof color);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const int x0 = place.block_x(b), y0 = place.block_y(b);
      if (x0 < place.width && y0 < place.height) blocks |= 1u << b;
      for (int l = 0; l < kPixelsPerBlock; ++l) {
        const bool inside = x0 + (l & 3) < place.width && y0 + (l >> 2) < place.height;
        running[b][l] = inside ? 1.0f : 0.0f;
        final[b][l] = 1.0f;
        last[b][l] = -1;
      }
    }
    return blocks;
  }

  // Blends the gathered chunk, whose first entry is at list position `base`, into one block. Returns false when the
  // block is finished.
  MUDG_INLINE bool blend_block(int b, int base, const TilePlace& place, Floats cap) {
    const Floats pixel_x = place.pixel_x(b), pixel_y = place.pixel_y(b), stop = splat(kStopTransmittance);
    const std::uint8_t* entries = chunk.lists.entries[b];
    Floats transmittance = load(running[b]), behind = load(final[b]);
    Ints last_position = load_int(last[b]);
    Floats sums[kChannels];
    for (int c = 0; c < kChannels; ++c) sums[c] = load(color[b][c]);
    Mask alive = transmittance > stop;
    for (int first = 0; first < chunk.lists.counts[b] && bits(alive) != 0; first += kBatch) {
      const int count = smaller(kBatch, chunk.lists.counts[b] - first);
      raw_alphas(chunk.rows, chunk.kRow, entries + first, count, pixel_x, pixel_y, alphas);
      for (int j = 0; j < count; ++j) {
        const int entry = entries[first + j];
        const float* row = chunk.row(entry);
        const Floats alpha = min_of(load(alphas[j]), cap);
        // Transmittance only falls, so a pixel that has stopped stays so without a mask on the critical path.
        const Floats next = neg_mul_add(alpha, transmittance, transmittance);
        alive = next > stop;
        const Floats weight = keep(alive, alpha * transmittance);
        transmittance = next;
        behind = select(alive, next, behind);
        last_position = select_int(alive, splat_int(base + entry), last_position);
        for (int c = 0; c < kChannels; ++c) sums[c] = mul_add(splat(row[kFirstChannel + c]), weight, sums[c]);
      }
      transmittance = keep(alive, transmittance);  // before it gets so small that arithmetic becomes slow
    }
    store(running[b], transmittance);
    store(final[b], behind);
    store_int(last[b], last_position);
    for (int c = 0; c < kChannels; ++c) store(color[b][c], sums[c]);
    return bits(alive) != 0;
  }

  // Turns accumulated depth into expected depth, and keeps it for the backward pass (`kept`: [16 blocks][16 pixels]).
  MUDG_INLINE void divide_depth(float* kept) {
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const Floats alpha = splat(1.0f) - load(final[b]);
      const Floats depth = keep(alpha > splat(kLeastAlpha), load(color[b][3]) / max_of(alpha, splat(kLeastAlpha)));
      store(color[b][3], depth);
      store(kept + b * kPixelsPerBlock, depth);
    }
  }

  MUDG_INLINE void write(const TilePlace& place, int channels, float* const* planes, float* alpha) const {
    const std::size_t stride = static_cast<std::size_t>(place.width);
    if (place.whole()) {  // rows of 64 bytes
      for (int y = 0; y < kTileSize; ++y) {
        const std::size_t at = (place.y + y) * stride + place.x;
        const int b = (y >> 2) * 4, l = (y & 3) * 4;
        for (int c = 0; c < channels; ++c) {
          for (int q = 0; q < 4; ++q) std::memcpy(planes[c] + at + 4 * q, &color[b + q][c][l], 16);
        }
        for (int x = 0; x < kTileSize; ++x) alpha[at + x] = 1.0f - final[b + (x >> 2)][l + (x & 3)];
      }
      return;
    }
    for (int b = 0; b < kBlocksPerTile; ++b) {
      for (int l = 0; l < kPixelsPerBlock; ++l) {
        const int x = place.block_x(b) + (l & 3), y = place.block_y(b) + (l >> 2);
        if (x >= place.width || y >= place.height) continue;
        for (int c = 0; c < channels; ++c) planes[c][y * stride + x] = color[b][c][l];
        alpha[y * stride + x] = 1.0f - final[b][l];
      }
    }
  }
};

template <int kChannels>
void blend_tile(RasterState& state, int tile, float* const* planes, float* alpha) {
  const TilePlace place(state, tile);
  const TileItem* items = state.items + state.tile_start[tile];
  const int count = state.tile_start[tile + 1] - state.tile_start[tile];
  ForwardTile<kChannels> work;
  unsigned blocks = work.start(place);
  Lookahead ahead;
  ahead.pixels_of(place);  // the output is written at the end
  const Floats cap = splat(state.scene.alpha_max);
  for (int base = 0; base < count && blocks != 0; base += kChunk) {
    work.chunk.gather(state, items + base, smaller(kChunk, count - base), blocks);
    // The lists of consecutive tiles lie side by side.
    const TileItem *next = items + smaller(base + kChunk, count), *end = state.items + state.entry_count;
    ahead.splats_of(next, next + smaller<std::ptrdiff_t>(kChunk, end - next));
    for (unsigned left = blocks; left != 0; left &= left - 1) {
      const int b = __builtin_ctz(left);
      ahead.helping<true>(state, planes, alpha);
      if (work.chunk.lists.counts[b] > 0 && !work.blend_block(b, base, place, cap)) blocks &= ~(1u << b);
    }
  }
  work.divide_depth(state.expected_depth + static_cast<std::size_t>(tile) * kPixelsPerTile);
  std::memcpy(state.final_transmittance + static_cast<std::size_t>(tile) * kPixelsPerTile, work.final,
              sizeof work.final);
  std::memcpy(state.last_item + static_cast<std::size_t>(tile) * kPixelsPerTile, work.last, sizeof work.last);
  work.write(place, state.channels, planes, alpha);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
