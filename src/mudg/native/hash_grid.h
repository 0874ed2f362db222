// Multi-resolution hash grid (Mueller et al. 2022) in 3 or 4 dimensions: features of points, and the gradients of tables and points.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr std::int64_t kHashGridPiece = 2048;  // points per piece of work
constexpr std::uint32_t kHashGridPrimes[4] = {1u, 2654435761u, 805459861u, 3674653429u};

// A point on one level: for every axis the two terms of the entry's number and the two weights.
template <int D>
struct HashGridCell {
  std::uint32_t term[D][2];
  float share[D][2];
  bool inside[D];

  MUDG_INLINE void place(const float* point, const HashGridLevel& level) {
    std::uint32_t stride = 1;
    for (int d = 0; d < D; ++d) {
      const float given = point[d];
      inside[d] = given >= 0.0f && given <= 1.0f;
      const float at = (given > 0.0f ? (given < 1.0f ? given : 1.0f) : 0.0f) * static_cast<float>(level.resolution);
      std::int32_t whole = static_cast<std::int32_t>(at);
      if (whole > level.resolution - 1) whole = level.resolution - 1;
      const auto first = static_cast<std::uint32_t>(whole);
      share[d][1] = at - static_cast<float>(whole);
      share[d][0] = 1.0f - share[d][1];
      const std::uint32_t factor = level.hashed ? kHashGridPrimes[d] : stride;
      term[d][0] = first * factor;
      term[d][1] = (first + 1u) * factor;
      stride *= static_cast<std::uint32_t>(level.resolution + 1);
    }
  }

  MUDG_INLINE std::uint32_t entry(int corner, const HashGridLevel& level) const {
    std::uint32_t number = term[0][corner & 1];
    if (level.hashed) {
      for (int d = 1; d < D; ++d) number ^= term[d][(corner >> d) & 1];
      return number & level.mask;
    }
    for (int d = 1; d < D; ++d) number += term[d][(corner >> d) & 1];
    return number;
  }

  MUDG_INLINE float weight(int corner) const {
    float product = 1.0f;
    for (int d = 0; d < D; ++d) product *= share[d][(corner >> d) & 1];
    return product;
  }
};

template <int D, int F>
void hash_grid_features(const HashGridJob& job) {
  const std::int64_t pieces = (job.points + kHashGridPiece - 1) / kHashGridPiece;
  const std::int64_t width = static_cast<std::int64_t>(job.level_count) * F;
  // Level after level, so that a piece of one level's table stays in the cache.
  parallel_for(pieces * job.level_count, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t task = begin; task < end; ++task) {
      const int l = static_cast<int>(task / pieces);
      const HashGridLevel& level = job.levels[l];
      const float* table = job.table + level.offset * F;
      const std::int64_t from = task % pieces * kHashGridPiece, to = smaller(job.points, from + kHashGridPiece);
      for (std::int64_t n = from; n < to; ++n) {
        HashGridCell<D> cell;
        cell.place(job.x + n * D, level);
        float sum[F] = {};
        for (int corner = 0; corner < 1 << D; ++corner) {
          const float weight = cell.weight(corner);
          const float* entry = table + static_cast<std::size_t>(cell.entry(corner, level)) * F;
          for (int f = 0; f < F; ++f) sum[f] += weight * entry[f];
        }
        float* out = job.out + n * width + l * F;
        for (int f = 0; f < F; ++f) out[f] = sum[f];
      }
    }
  });
}

// Every level is one piece of work that adds its points up in their order: the sums do not depend on the number of threads.
template <int D, int F>
void hash_grid_of_table(const HashGridJob& job) {
  const std::int64_t width = static_cast<std::int64_t>(job.level_count) * F;
  parallel_for(job.level_count, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t l = begin; l < end; ++l) {
      const HashGridLevel& level = job.levels[l];
      float* table = job.of_table + level.offset * F;
      for (std::int64_t i = 0; i < level.entries * F; ++i) table[i] = 0.0f;
      for (std::int64_t n = 0; n < job.points; ++n) {
        const float* gradient = job.gradient + n * width + l * F;
        HashGridCell<D> cell;
        cell.place(job.x + n * D, level);
        for (int corner = 0; corner < 1 << D; ++corner) {
          const float weight = cell.weight(corner);
          float* entry = table + static_cast<std::size_t>(cell.entry(corner, level)) * F;
          for (int f = 0; f < F; ++f) entry[f] += weight * gradient[f];
        }
      }
    }
  });
}

template <int D, int F>
void hash_grid_of_points(const HashGridJob& job) {
  const std::int64_t width = static_cast<std::int64_t>(job.level_count) * F;
  parallel_for(job.points, kHashGridPiece, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t n = begin; n < end; ++n) {
      float sum[D] = {};
      bool inside[D] = {};
      for (int l = 0; l < job.level_count; ++l) {
        const HashGridLevel& level = job.levels[l];
        const float* table = job.table + level.offset * F;
        const float* gradient = job.gradient + n * width + l * F;
        HashGridCell<D> cell;
        cell.place(job.x + n * D, level);
        float along[1 << D], slope[D][1 << D];
        for (int corner = 0; corner < 1 << D; ++corner) {
          const float* entry = table + static_cast<std::size_t>(cell.entry(corner, level)) * F;
          along[corner] = 0.0f;
          for (int f = 0; f < F; ++f) along[corner] += gradient[f] * entry[f];
        }
        // One axis after the other is blended away, the last one first; its own slope is the difference.
        for (int d = D - 1; d >= 0; --d) {
          const int left = 1 << d;
          for (int k = 0; k < left; ++k) {
            slope[d][k] = along[k + left] - along[k];
            along[k] = cell.share[d][0] * along[k] + cell.share[d][1] * along[k + left];
            for (int e = d + 1; e < D; ++e)
              slope[e][k] = cell.share[d][0] * slope[e][k] + cell.share[d][1] * slope[e][k + left];
          }
        }
        for (int d = 0; d < D; ++d) {
          sum[d] += static_cast<float>(level.resolution) * slope[d][0];
          inside[d] = cell.inside[d];
        }
      }
      for (int d = 0; d < D; ++d) job.of_x[n * D + d] = inside[d] ? sum[d] : 0.0f;
    }
  });
}

template <int D, int F>
void hash_grid_of(const HashGridJob& job) {
  if (job.out != nullptr) hash_grid_features<D, F>(job);
  if (job.of_table != nullptr) hash_grid_of_table<D, F>(job);
  if (job.of_x != nullptr) hash_grid_of_points<D, F>(job);
}

template <int D>
void hash_grid_in(const HashGridJob& job) {
  switch (job.features) {
    case 1: return hash_grid_of<D, 1>(job);
    case 2: return hash_grid_of<D, 2>(job);
    case 4: return hash_grid_of<D, 4>(job);
    default: return hash_grid_of<D, 8>(job);
  }
}

void hash_grid(const HashGridJob& job) {
  if (job.dimensions == 3) return hash_grid_in<3>(job);
  hash_grid_in<4>(job);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
