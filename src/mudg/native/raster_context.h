// Owns the memory of one forward pass until its backward pass is over. Several contexts may be alive at once.
#pragma once

#include "buffer.h"
#include "raster_types.h"

namespace mudg {

enum RasterPhase {
  kPhaseProject,
  kPhaseSort,
  kPhaseBin,
  kPhaseBlend,
  kPhaseBlendBackward,
  kPhaseProjectBackward,
  kPhases
};

struct RasterContext {
  RasterState state{};
  double phase_s[kPhases] = {};

  RasterContext() = default;
  RasterContext(const RasterContext&) = delete;
  RasterContext& operator=(const RasterContext&) = delete;
  ~RasterContext();

  bool prepare(const RasterScene& scene);  // sizes and per-Gaussian memory; false: no memory
  RasterStatus sort_by_depth();            // raster_binning.cpp
  RasterStatus bin_into_tiles();           // raster_binning.cpp
  void mark_ranges(const int* range_begin, int ranges);
  void bin_block(const std::uint32_t* gaussians, int count, int low, unsigned width);
  bool prepare_backward();
  std::size_t bytes() const;

  Buffer<float> splats, final_transmittance, expected_depth, records;
  Buffer<std::uint8_t> clamped, entry_worker, range_groups;
  Buffer<std::uint32_t> depth_key, entry_offset, order, sort_key, sort_order, sort_key2;
  Buffer<std::int32_t> entry_counts, first_record, tile_start, tile_cursor, last_item, sort_counts;
  Buffer<TileItem> items;
  Buffer<double> camera_parts;
  Buffer<std::int32_t> tile_counts[kMaxThreads];
};

}  // namespace mudg
