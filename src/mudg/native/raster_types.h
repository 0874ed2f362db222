// What the stages of the rasteriser hand to each other. Plain structs: the kernels are compiled once per instruction
// set and see no container from the standard library.
//
// Stages of a forward pass: project (Gaussian -> ellipse, colour, touched tiles) -> sort by depth -> bin into tiles ->
// blend. Backward: blend backward (per tile, back to front, one gradient record per Gaussian and tile) -> project
// backward.
#pragma once

#include <cstddef>
#include <cstdint>

#include "parallel.h"

namespace mudg {

constexpr int kTileSize = 16;  // pixels; a tile is 4 x 4 blocks
constexpr int kBlockSize = 4;  // pixels; the 16 pixels of a block are one SIMD vector
constexpr int kBlocksPerTile = 16;
constexpr int kPixelsPerBlock = 16;
constexpr int kPixelsPerTile = kTileSize * kTileSize;
constexpr int kMaxChannels = 32;             // RGB + depth + features
constexpr float kStopTransmittance = 1e-4f;  // a pixel is finished when its transmittance would fall to this or below
constexpr float kLog2Of255 = 7.994353436858858f;  // contributions below alpha = 1/255 are dropped
constexpr float kLog2E = 1.4426950408889634f;
constexpr float kLeastAlpha = 1e-10f;        // below, a pixel has no depth
constexpr float kLn2 = 0.6931471805599453f;
constexpr float kFar = 1e10f;  // metres; nothing farther away is drawn, by any backend

// One projected Gaussian, followed by its channel values: R, G, B, depth, features.
// log2 of its alpha at distance (dx, dy) from its mean: kLogOpacity - kStretch * (dx + kShear * dy)^2 - kHeight * dy^2.
enum SplatField { kMeanX, kMeanY, kStretch, kShear, kHeight, kLogOpacity, kOpacity, kDepth, kFirstChannel };

// One gradient record (a Gaussian in a tile): moments of the gradient with respect to sigma about the tile's centre
// (1, x, y, xx, xy, yy), two sums of absolute mean gradients, then the gradients of the channel values.
enum RecordField { kMoments = 0, kAbsX = 6, kAbsY = 7, kRecordChannels = 8 };
constexpr std::uint32_t kNoContribution = 0xffabcdefu;  // bit pattern in field 0 of a record that nothing was added to

// A tile that a Gaussian touches, and which of the tile's 16 blocks (bit 4 * block_row + block_column).
struct TileEntry {
  std::int32_t tile;
  std::uint32_t blocks;
};

// An entry of a tile's list, front to back.
struct TileItem {
  std::int32_t gaussian;
  std::int32_t record;
  std::uint32_t blocks;
};

// extern "C" structs; native mirrors in core/raster/cpu.py. Pointers to float32 unless said otherwise.
struct RasterScene {
  std::int32_t count, width, height, extra_channels, sh_coefficients, antialias, want_abs_gradient;
  float near_m, blur_px2, alpha_max;
  float fx, fy, cx, cy;
  float rotation[9];                    // cam_from_world, row by row
  float center_high[3], center_low[3];  // camera centre in the world as a sum of two floats
  const float *means, *quats, *scales, *opacities, *sh, *extra;  // [N,3] [N,4] [N,3] [N] [N,K,3] [N,C]
  const float* sh_rest;  // null, or harmonics from the second on [N,K-1,3]; `sh` is then [N,1,3]
};

struct RasterImage {
  float *rgb, *depth, *alpha, *extra;  // [3,H,W] [H,W] expected z [H,W] [C,H,W]
  float* means2d;                      // [N,2], 0 where not drawn
  std::int32_t* radii;                 // [N,2], 0 where not drawn
};

struct RasterImageGradient {
  const float *rgb, *depth, *alpha, *extra;  // as RasterImage; null counts as zero
};

struct RasterGradient {
  float *means, *quats, *scales, *opacities;  // never null
  float *sh, *extra, *means2d, *abs_means2d;  // null: not wanted
  float* sh_rest;                             // as in the scene; written whenever `sh` is
  float rotation[9], center[3];
};

// The harmonics of one Gaussian, or their gradient: the first one, and those that follow it.
template <class Number>
struct Harmonics {
  Number *first, *rest;
};
template <class Number>
inline __attribute__((always_inline)) Harmonics<Number> harmonics_of(const RasterScene& scene, Number* sh,
                                                                     Number* sh_rest, std::size_t gaussian) {
  const std::size_t coefficients = static_cast<std::size_t>(scene.sh_coefficients);
  if (scene.sh_rest != nullptr) return {sh + 3 * gaussian, sh_rest + 3 * gaussian * (coefficients - 1)};
  return {sh + 3 * gaussian * coefficients, sh + 3 * gaussian * coefficients + 3};
}

enum class RasterStatus : int { kOk = 0, kOutOfMemory = 1, kTooManyEntries = 2, kNotFinite = 3 };

// Tile entries that one worker made, in the order in which it met the Gaussians, and how many fell into each tile. A
// cache line for each worker: `used` changes with every Gaussian.
struct alignas(64) WorkerEntries {
  TileEntry* entries;
  std::size_t used, capacity;
  std::int32_t* tile_counts;

  // Room for `count` more entries, or null when memory ran out.
  __attribute__((always_inline)) TileEntry* room(std::size_t count) {
    return used + count <= capacity ? entries + used : grow(count);
  }
  TileEntry* grow(std::size_t count);
};

// Views into the buffers of a RasterContext; valid from a forward pass to the next one on the same context.
struct RasterState {
  RasterScene scene;
  int channels;         // 4 + extra
  int padded_channels;  // rounded up to a multiple of 4
  int splat_stride;     // floats per splat
  int record_stride;    // floats per gradient record
  int tiles_x, tiles_y;
  std::int64_t visible_count, entry_count;

  float* splats;                // [N][splat_stride], written for visible Gaussians only
  std::uint8_t* clamped;        // [N] bit c: colour channel c was cut off at zero
  std::uint32_t* depth_key;     // [N] depth bits, kHidden when no tile is touched
  std::uint32_t* entry_offset;  // [N] into the entries of worker entry_worker
  std::int32_t* entry_counts;   // [N] tiles touched
  std::uint8_t* entry_worker;   // [N]
  std::int32_t* first_record;   // [N + 1]
  std::uint32_t* order;         // [visible_count] Gaussians front to back
  std::int32_t* tile_start;     // [tiles + 1]
  TileItem* items;              // [entry_count]
  float* final_transmittance;   // [tiles][16 blocks][16 pixels]
  std::int32_t* last_item;      // the same layout: last list position before the pixel was finished, -1 if none
  float* expected_depth;        // the same layout: the depth image
  float* records;               // [entry_count][record_stride]
  double* camera_parts;         // [chunks][16] per-chunk parts of the camera's gradient
  int worker_count;             // workers that may take part in projecting
  WorkerEntries workers[kMaxThreads];

  std::int64_t not_finite_count;
  std::int64_t first_not_finite;  // smallest index, count if none
  std::int32_t out_of_memory;
};
constexpr std::uint32_t kHidden = 0xffffffffu;
constexpr int kCameraChunk = 64;  // blocks of 16 Gaussians summed into one part of the camera gradient

}  // namespace mudg
