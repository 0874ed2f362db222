#include "raster_context.h"

#include <algorithm>
#include <cstdlib>

namespace mudg {
namespace {

int round_up(int value, int step) { return (value + step - 1) / step * step; }

}  // namespace

TileEntry* WorkerEntries::grow(std::size_t count) {
  const std::size_t wanted = (used + count) * 3 / 2 + 4096;
  void* moved = std::realloc(entries, wanted * sizeof(TileEntry));
  if (moved == nullptr) return nullptr;
  entries = static_cast<TileEntry*>(moved);
  capacity = wanted;
  return entries + used;
}

RasterContext::~RasterContext() {
  for (WorkerEntries& worker : state.workers) std::free(worker.entries);
}

bool RasterContext::prepare(const RasterScene& scene) {
  state.scene = scene;
  state.channels = 4 + scene.extra_channels;
  state.padded_channels = round_up(state.channels, 4);
  state.splat_stride = kFirstChannel + state.padded_channels;
  state.record_stride = kRecordChannels + state.padded_channels;
  state.tiles_x = (scene.width + kTileSize - 1) / kTileSize;
  state.tiles_y = (scene.height + kTileSize - 1) / kTileSize;
  state.visible_count = state.entry_count = 0;
  state.not_finite_count = 0;
  state.first_not_finite = scene.count;
  state.out_of_memory = 0;

  const std::size_t count = static_cast<std::size_t>(scene.count);
  const std::size_t tiles = static_cast<std::size_t>(state.tiles_x) * state.tiles_y;
  const bool ok = splats.reserve(count * state.splat_stride + 64) && clamped.reserve(count + 16) &&
                  entry_worker.reserve(count + 16) && depth_key.reserve(count + 16) &&
                  entry_offset.reserve(count + 16) && entry_counts.reserve(count + 16) &&
                  first_record.reserve(count + 17) && tile_start.reserve(tiles + 1) && tile_cursor.reserve(tiles + 1) &&
                  final_transmittance.reserve(tiles * kPixelsPerTile) && last_item.reserve(tiles * kPixelsPerTile) &&
                  expected_depth.reserve(tiles * kPixelsPerTile);
  if (!ok) return false;
  state.splats = splats.data();
  state.clamped = clamped.data();
  state.entry_worker = entry_worker.data();
  state.depth_key = depth_key.data();
  state.entry_offset = entry_offset.data();
  state.entry_counts = entry_counts.data();
  state.first_record = first_record.data();
  state.tile_start = tile_start.data();
  state.final_transmittance = final_transmittance.data();
  state.last_item = last_item.data();
  state.expected_depth = expected_depth.data();
  state.worker_count = thread_count();
  for (int worker = 0; worker < state.worker_count; ++worker) {
    if (!tile_counts[worker].reserve(tiles)) return false;
    state.workers[worker].used = 0;
    state.workers[worker].tile_counts = tile_counts[worker].data();
    std::fill_n(state.workers[worker].tile_counts, tiles, 0);
  }
  return true;
}

bool RasterContext::prepare_backward() {
  const std::size_t blocks = (static_cast<std::size_t>(state.scene.count) + 15) / 16;
  const std::size_t chunks = (blocks + kCameraChunk - 1) / kCameraChunk;
  if (!records.reserve(static_cast<std::size_t>(state.entry_count) * state.record_stride + 64)) return false;
  if (!camera_parts.reserve(chunks * 16 + 16)) return false;
  state.records = records.data();
  state.camera_parts = camera_parts.data();
  return true;
}

std::size_t RasterContext::bytes() const {
  std::size_t total = splats.bytes() + final_transmittance.bytes() + expected_depth.bytes() + records.bytes() +
                      clamped.bytes() + entry_worker.bytes() + depth_key.bytes() + entry_offset.bytes() +
                      order.bytes() + sort_key.bytes() + sort_key2.bytes() + sort_order.bytes() + entry_counts.bytes() +
                      first_record.bytes() + tile_start.bytes() + tile_cursor.bytes() + last_item.bytes() +
                      items.bytes() + camera_parts.bytes() + range_groups.bytes() + sort_counts.bytes();
  for (int worker = 0; worker < kMaxThreads; ++worker) {
    total += tile_counts[worker].bytes() + state.workers[worker].capacity * sizeof(TileEntry);
  }
  return total;
}

}  // namespace mudg
