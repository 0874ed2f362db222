// Depth order of the visible Gaussians, and from it the depth-ordered list of every tile.
#include <algorithm>
#include <cstring>
#include <limits>

#include "raster_context.h"

namespace mudg {
namespace {

constexpr int kDigits = 3;
constexpr int kDigitBits = 11;
constexpr std::uint32_t kDigitMask = (1u << kDigitBits) - 1;

}  // namespace

// A stable radix sort on the bits of the depth (positive floats order like integers): Gaussians at equal depth keep
// their order.
RasterStatus RasterContext::sort_by_depth() {
  const int count = state.scene.count;
  std::int64_t entries = 0;
  std::size_t visible = 0;
  static thread_local std::uint32_t histogram[kDigits][1 << kDigitBits];
  std::memset(histogram, 0, sizeof histogram);
  for (int g = 0; g < count; ++g) {
    const std::uint32_t key = state.depth_key[g];
    if (key == kHidden) continue;
    ++visible;
    entries += state.entry_counts[g];
    for (int digit = 0; digit < kDigits; ++digit) ++histogram[digit][(key >> (digit * kDigitBits)) & kDigitMask];
  }
  if (entries > std::numeric_limits<std::int32_t>::max() / 2) return RasterStatus::kTooManyEntries;
  if (!order.reserve(visible + 16) || !sort_key.reserve(visible + 16) || !sort_key2.reserve(visible + 16) ||
      !sort_order.reserve(visible + 16)) {
    return RasterStatus::kOutOfMemory;
  }
  for (auto& digit : histogram) {
    std::uint32_t before = 0;
    for (std::uint32_t& bucket : digit) {
      const std::uint32_t here = bucket;
      bucket = before;
      before += here;
    }
  }
  std::uint32_t *keys = sort_key.data(), *ids = sort_order.data(), *keys2 = sort_key2.data(), *ids2 = order.data();
  std::int32_t record = 0;
  for (int g = 0; g < count; ++g) {
    state.first_record[g] = record;
    const std::uint32_t key = state.depth_key[g];
    if (key == kHidden) continue;
    record += state.entry_counts[g];
    const std::uint32_t place = histogram[0][key & kDigitMask]++;
    keys2[place] = key;
    ids2[place] = static_cast<std::uint32_t>(g);
  }
  state.first_record[count] = record;
  for (std::size_t i = 0; i < visible; ++i) {
    const std::uint32_t key = keys2[i];
    const std::uint32_t place = histogram[1][(key >> kDigitBits) & kDigitMask]++;
    keys[place] = key;
    ids[place] = ids2[i];
  }
  for (std::size_t i = 0; i < visible; ++i) ids2[histogram[2][keys[i] >> (2 * kDigitBits)]++] = ids[i];
  state.order = ids2;
  state.visible_count = static_cast<std::int64_t>(visible);
  state.entry_count = entries;
  return RasterStatus::kOk;
}

// Every worker walks all Gaussians in depth order and keeps what falls into its own contiguous range of tiles; the
// ranges are balanced by the number of entries. No atomics, and the same lists for any number of workers.
RasterStatus RasterContext::bin_into_tiles() {
  const int tiles = state.tiles_x * state.tiles_y;
  if (!items.reserve(static_cast<std::size_t>(state.entry_count) + 16)) return RasterStatus::kOutOfMemory;
  state.items = items.data();
  std::int32_t* cursor = tile_cursor.data();
  std::int32_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    state.tile_start[tile] = cursor[tile] = total;
    for (int worker = 0; worker < state.worker_count; ++worker) total += state.workers[worker].tile_counts[tile];
  }
  state.tile_start[tiles] = total;

  const RasterState& s = state;
  const int ranges = state.worker_count;
  const std::int32_t* starts = state.tile_start;
  const auto range_begin = [&](int range) {
    if (range == ranges) return tiles;
    const auto wanted = static_cast<std::int32_t>(static_cast<std::int64_t>(total) * range / ranges);
    return static_cast<int>(std::lower_bound(starts, starts + tiles, wanted) - starts);
  };
  parallel_for(ranges, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (int range = static_cast<int>(begin); range < static_cast<int>(end); ++range) {
      const int low = range_begin(range);
      const unsigned width = static_cast<unsigned>(range_begin(range + 1) - low);
      for (std::int64_t rank = 0; rank < s.visible_count; ++rank) {
        if (rank + 16 < s.visible_count) {
          const std::uint32_t later = s.order[rank + 16];
          __builtin_prefetch(s.entry_offset + later);
          __builtin_prefetch(s.entry_counts + later);
          __builtin_prefetch(s.first_record + later);
          __builtin_prefetch(s.entry_worker + later);
        }
        if (rank + 8 < s.visible_count) {
          const std::uint32_t soon = s.order[rank + 8];
          __builtin_prefetch(s.workers[s.entry_worker[soon]].entries + s.entry_offset[soon]);
        }
        const std::uint32_t g = s.order[rank];
        const TileEntry* entry = s.workers[s.entry_worker[g]].entries + s.entry_offset[g];
        const int touched = s.entry_counts[g];
        const std::int32_t record = s.first_record[g];
        for (int k = 0; k < touched; ++k) {
          if (static_cast<unsigned>(entry[k].tile - low) < width) {
            s.items[cursor[entry[k].tile]++] = {static_cast<std::int32_t>(g), record + k, entry[k].blocks};
          }
        }
      }
    }
  });
  return RasterStatus::kOk;
}

}  // namespace mudg
