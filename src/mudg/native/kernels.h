// The kernels that exist once per instruction set, as a table of function pointers.
#pragma once

#include <cstddef>
#include <cstdint>

#include "raster_types.h"

namespace mudg {

// The photometric loss (loss.h) on planar images [planes][height][width].
constexpr int kPhotometricApron = 16;  // zeros left and right of a row of a derivative map
constexpr int kPhotometricStrip = 48;  // rows per piece of work
struct PhotometricJob {
  const float *x, *y;
  const float* weight;  // [height][width], null: 1 everywhere
  int planes, height, width;
  float ssim_weight;
  float* gradient;                  // like x
  int padded_width = 0;             // multiple of 16
  int row_stride = 0;               // padded_width + two aprons
  float* maps = nullptr;            // [3][planes][height][row_stride]
  float* worker_scratch = nullptr;  // [workers][worker_stride]
  std::size_t worker_stride = 0;
  int workers = 0;
  double* partial = nullptr;  // [planes * strips]
};

// One Adam step (adam.h) on a table: columns [rows][width] that share their rows. Mirrored in core/native_ops.py.
struct AdamColumn {
  float* parameter;
  const float* gradient;
  float *moment1, *moment2;
  std::int64_t width;
  double rate;
  float step_size;  // rate / (1 - beta1^step), filled in by mudg_adam
};
struct AdamJob {
  const AdamColumn* columns;
  int column_count;
  std::int64_t rows;
  const std::uint8_t* visible;  // [rows], null: all
  float beta1, beta2, epsilon;
  float inv_root_bias2;  // 1 / sqrt(1 - beta2^step)
};

// Weighted cross entropy (classes.h) of logits [classes][pixels].
constexpr int kClassLossBlock = 64;  // pixels worked on together
constexpr std::int64_t kClassLossPiece = 4096;  // pixels per piece of work, a multiple of the block
struct ClassLossJob {
  const float* logits;
  const std::int64_t* target;  // [pixels]; outside 0..classes-1: no label
  const float* weight;         // [pixels]
  const float* lift;           // [pixels], added to the logits of channel `raised`; null with raised = -1
  int raised, classes;
  std::int64_t pixels;
  float scale;
  float* gradient;                  // like logits
  float* worker_scratch = nullptr;  // [workers][classes][kClassLossBlock], 64-byte aligned
  int workers = 0;
  double* partial = nullptr;  // one per piece
};

// A picture over a coarse one (over.h), [channels][height][width]: forward with gradient = null, else backward.
struct OverJob {
  const float *rgb, *alpha, *coarse;  // rgb: forward only
  int channels, height, width, coarse_height, coarse_width;
  float* out;             // forward
  const float* gradient;  // of out
  float *of_alpha, *of_coarse;
  float* row_sums = nullptr;        // [channels][height][coarse_width], backward
  float* worker_scratch = nullptr;  // [workers][coarse_width + width]
  void* columns = nullptr;          // 12 bytes for every column
  int workers = 0;
};

// Means over squares of 2 radius + 1 pixels of planar images (box.h), cut at the borders; or the transposed map.
struct BoxJob {
  const float* x;
  int planes, height, width, radius;
  bool transposed;
  float* out;
  float* worker_scratch;  // [workers][width + 2 radius]
  int workers;
};

// Features of points in a multi-resolution hash grid (hash_grid.h), and gradients; what is null is not computed.
struct HashGridLevel {
  std::int64_t offset, entries;  // in the table, in entries
  std::int32_t resolution;       // cells along an axis
  std::uint32_t mask;            // entries - 1 where hashed: they are a power of two
  bool hashed;                   // else the entries are the corners in their order, the first axis fastest
};
struct HashGridJob {
  const float* x;  // [points][dimensions] in 0..1; outside: the value at the border
  const float* table;  // [entries of all levels][features]
  const HashGridLevel* levels;
  int dimensions, level_count, features;  // 3 or 4; any; 1, 2, 4 or 8
  std::int64_t points;
  float* out;             // [points][level_count * features]
  const float* gradient;  // like out
  float *of_table, *of_x;  // like table and x
};

// Features of places and times in six planes of several sizes (hex_planes.h), and gradients; what is null is not computed.
constexpr int kHexPlanes = 6;
constexpr int kHexAxes[kHexPlanes][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};  // xy, xz, yz, xt, yt, zt
struct HexPlanesLevel {
  std::int64_t offset[kHexPlanes];  // of the planes, in floats; a plane is [second axis][first axis][features]
  std::int32_t cells[4];            // numbers along x, y, z, t
};
struct HexPlanesJob {
  const float* x;  // [points][4] in -1..1; outside: the value at the border
  const float* planes;
  const HexPlanesLevel* levels;
  int level_count, features;  // any; 1, 2, 4, 8, 16 or 32
  std::int64_t points;
  float* out;               // [points][level_count * features]
  const float* gradient;    // like out
  float *of_planes, *of_x;  // like planes and x; added to
};

struct Kernels {
  void (*project_forward)(RasterState&, RasterImage&);
  void (*blend_forward)(RasterState&, RasterImage&);
  void (*blend_backward)(RasterState&, const RasterImageGradient&);
  void (*project_backward)(RasterState&, RasterGradient&);
  double (*photometric)(const PhotometricJob&);
  void (*adam)(const AdamJob&);
  double (*class_loss)(const ClassLossJob&);
  void (*over)(const OverJob&);
  void (*box_mean)(const BoxJob&);
  void (*hash_grid)(const HashGridJob&);
  void (*hex_planes)(const HexPlanesJob&);
  double (*peak_multiply_add)(std::int64_t rounds, float* sink);
};

const Kernels& kernels_portable();
#if defined(__x86_64__)
const Kernels& kernels_avx2();
const Kernels& kernels_avx512();
#endif

// The table for the instruction set in force (cpu.h).
const Kernels& kernels();

}  // namespace mudg
