// Depth order of the visible Gaussians, and from it the depth-ordered list of every tile.
#include <algorithm>
#include <cstring>
#include <limits>

#include "raster_context.h"

namespace mudg {
namespace {

constexpr int kDigits = 3;
constexpr int kDigitBits = 11;
constexpr int kBuckets = 1 << kDigitBits;
constexpr int kSortGrain = 16384;   // Gaussians that are worth a worker of their own
constexpr int kRankBlock = 2048;    // ranks of the depth order that a worker picks its own from at a time
constexpr int kMostRangeGroups = 8;  // bits of the per-Gaussian mask of tile ranges

inline int digit_of(std::uint32_t key, int digit) {
  return static_cast<int>((key >> (digit * kDigitBits)) & (kBuckets - 1));
}

// Turns the counts [part][bucket] into the places where each part's keys of each bucket begin: bucket after bucket,
// within a bucket part after part, so that the order is that of one part that does all.
void counts_to_places(std::int32_t* counts, int parts) {
  std::int32_t before = 0;
  for (int bucket = 0; bucket < kBuckets; ++bucket) {
    for (int part = 0; part < parts; ++part) {
      std::int32_t& place = counts[part * kBuckets + bucket];
      const std::int32_t here = place;
      place = before;
      before += here;
    }
  }
}

}  // namespace

// A stable radix sort on the bits of the depth (positive floats order like integers): Gaussians at equal depth keep
// their order. A stable order is unique, so the number of parts does not show in it.
RasterStatus RasterContext::sort_by_depth() {
  const std::int64_t count = state.scene.count;
  const int parts = static_cast<int>(std::clamp<std::int64_t>(count / kSortGrain, 1, state.worker_count));
  if (!sort_counts.reserve(static_cast<std::size_t>(kDigits) * parts * kBuckets)) return RasterStatus::kOutOfMemory;
  std::int32_t* counts[kDigits];
  for (int digit = 0; digit < kDigits; ++digit) counts[digit] = sort_counts.data() + digit * parts * kBuckets;
  std::memset(counts[0], 0, sizeof(std::int32_t) * kDigits * parts * kBuckets);
  std::int64_t entries_of[kMaxThreads] = {}, visible_of[kMaxThreads] = {};
  parallel_for(parts, 1, [&](std::int64_t part, std::int64_t, int) {
    std::int64_t visible = 0, entries = 0;
    std::int32_t* lowest = counts[0] + part * kBuckets;
    for (std::int64_t g = count * part / parts; g < count * (part + 1) / parts; ++g) {
      const std::uint32_t key = state.depth_key[g];
      if (key == kHidden) continue;
      ++visible;
      entries += state.entry_counts[g];
      ++lowest[digit_of(key, 0)];
      if (parts > 1) continue;  // else the higher digits are counted part by part once their input is in place
      for (int digit = 1; digit < kDigits; ++digit) ++counts[digit][digit_of(key, digit)];
    }
    visible_of[part] = visible;
    entries_of[part] = entries;
  });
  std::int64_t visible = 0, entries = 0, first_record_of[kMaxThreads];
  for (int part = 0; part < parts; ++part) {
    first_record_of[part] = entries;
    visible += visible_of[part];
    entries += entries_of[part];
  }
  if (entries > std::numeric_limits<std::int32_t>::max() / 2) return RasterStatus::kTooManyEntries;
  const std::size_t room = static_cast<std::size_t>(visible) + 16;
  if (!order.reserve(room) || !sort_key.reserve(room) || !sort_key2.reserve(room) || !sort_order.reserve(room))
    return RasterStatus::kOutOfMemory;
  std::uint32_t *keys = sort_key.data(), *ids = sort_order.data(), *keys2 = sort_key2.data(), *ids2 = order.data();
  counts_to_places(counts[0], parts);
  parallel_for(parts, 1, [&](std::int64_t part, std::int64_t, int) {
    std::int32_t* places = counts[0] + part * kBuckets;
    auto record = static_cast<std::int32_t>(first_record_of[part]);
    for (std::int64_t g = count * part / parts; g < count * (part + 1) / parts; ++g) {
      state.first_record[g] = record;
      const std::uint32_t key = state.depth_key[g];
      if (key == kHidden) continue;
      record += state.entry_counts[g];
      const std::int32_t place = places[digit_of(key, 0)]++;
      keys2[place] = key;
      ids2[place] = static_cast<std::uint32_t>(g);
    }
  });
  state.first_record[count] = static_cast<std::int32_t>(entries);
  const auto pass = [&](int digit, const std::uint32_t* keys_in, const std::uint32_t* ids_in, std::uint32_t* keys_out,
                        std::uint32_t* ids_out) {
    if (parts > 1) {
      parallel_for(parts, 1, [&](std::int64_t part, std::int64_t, int) {
        std::int32_t* own = counts[digit] + part * kBuckets;
        for (std::int64_t i = visible * part / parts; i < visible * (part + 1) / parts; ++i)
          ++own[digit_of(keys_in[i], digit)];
      });
    }
    counts_to_places(counts[digit], parts);
    parallel_for(parts, 1, [&](std::int64_t part, std::int64_t, int) {
      std::int32_t* places = counts[digit] + part * kBuckets;
      for (std::int64_t i = visible * part / parts; i < visible * (part + 1) / parts; ++i) {
        const std::uint32_t key = keys_in[i];
        const std::int32_t place = places[digit_of(key, digit)]++;
        if (keys_out != nullptr) keys_out[place] = key;
        ids_out[place] = ids_in[i];
      }
    });
  };
  pass(1, keys2, ids2, keys, ids);
  pass(2, keys, ids, nullptr, ids2);
  state.order = ids2;
  state.visible_count = visible;
  state.entry_count = entries;
  return RasterStatus::kOk;
}

// Notes for every Gaussian which groups of tile ranges its tiles fall into, so that a worker need not look at the
// entries of all. A Gaussian's entries are in ascending order of tiles.
void RasterContext::mark_ranges(const int* range_begin, int ranges) {
  const int groups = std::min(ranges, kMostRangeGroups);
  parallel_for(state.scene.count, kSortGrain / 4, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t g = begin; g < end; ++g) {
      const int touched = state.entry_counts[g];
      if (touched == 0) continue;
      const TileEntry* entry = state.workers[state.entry_worker[g]].entries + state.entry_offset[g];
      const auto group_of = [&](int tile) {
        int range = 0;
        for (int r = 1; r < ranges; ++r) range += tile >= range_begin[r];
        return range * groups / ranges;
      };
      const int first = group_of(entry[0].tile), last = group_of(entry[touched - 1].tile);
      range_groups.data()[g] = static_cast<std::uint8_t>((2u << last) - (1u << first));
    }
  });
}

// Every worker walks the depth order and keeps what falls into its own contiguous range of tiles; the ranges are
// balanced by the number of entries. No atomics, and the same lists for any number of workers.
RasterStatus RasterContext::bin_into_tiles() {
  const int tiles = state.tiles_x * state.tiles_y;
  if (!items.reserve(static_cast<std::size_t>(state.entry_count) + 16) ||
      !range_groups.reserve(static_cast<std::size_t>(state.scene.count) + 16)) {
    return RasterStatus::kOutOfMemory;
  }
  state.items = items.data();
  std::int32_t* cursor = tile_cursor.data();
  std::int32_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    state.tile_start[tile] = cursor[tile] = total;
    for (int worker = 0; worker < state.worker_count; ++worker) total += state.workers[worker].tile_counts[tile];
  }
  state.tile_start[tiles] = total;

  const int ranges = state.worker_count, groups = std::min(ranges, kMostRangeGroups);
  int range_begin[kMaxThreads + 1];
  for (int range = 0; range < ranges; ++range) {
    const auto wanted = static_cast<std::int32_t>(static_cast<std::int64_t>(total) * range / ranges);
    range_begin[range] =
        static_cast<int>(std::lower_bound(state.tile_start, state.tile_start + tiles, wanted) - state.tile_start);
  }
  range_begin[ranges] = tiles;
  if (ranges > 1) mark_ranges(range_begin, ranges);
  parallel_for(ranges, 1, [&](std::int64_t begin, std::int64_t end, int) {
    std::uint32_t mine[kRankBlock];
    for (int range = static_cast<int>(begin); range < static_cast<int>(end); ++range) {
      const int low = range_begin[range], group = range * groups / ranges;
      const auto width = static_cast<unsigned>(range_begin[range + 1] - low);
      for (std::int64_t from = 0; from < state.visible_count; from += kRankBlock) {
        const int ranks = static_cast<int>(std::min<std::int64_t>(kRankBlock, state.visible_count - from));
        if (ranges == 1) {
          bin_block(state.order + from, ranks, low, width);
          continue;
        }
        int kept = 0;
        for (int rank = 0; rank < ranks; ++rank) {  // always written, counted only if it is ours
          const std::uint32_t g = state.order[from + rank];
          mine[kept] = g;
          kept += (range_groups.data()[g] >> group) & 1;
        }
        bin_block(mine, kept, low, width);
      }
    }
  });
  return RasterStatus::kOk;
}

// Appends the entries of some Gaussians, front to back, to the lists of tiles low .. low + width - 1.
void RasterContext::bin_block(const std::uint32_t* gaussians, int count, int low, unsigned width) {
  const RasterState& s = state;
  std::int32_t* cursor = tile_cursor.data();
  for (int rank = 0; rank < count; ++rank) {
    if (rank + 16 < count) {
      const std::uint32_t later = gaussians[rank + 16];
      __builtin_prefetch(s.entry_offset + later);
      __builtin_prefetch(s.entry_counts + later);
      __builtin_prefetch(s.first_record + later);
      __builtin_prefetch(s.entry_worker + later);
    }
    if (rank + 8 < count) {
      const std::uint32_t soon = gaussians[rank + 8];
      __builtin_prefetch(s.workers[s.entry_worker[soon]].entries + s.entry_offset[soon]);
    }
    const std::uint32_t g = gaussians[rank];
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

}  // namespace mudg
