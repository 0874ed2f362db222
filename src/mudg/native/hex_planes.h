// Six planes of several sizes (K-Planes, Fridovich-Keil et al. 2023; HexPlane, Cao and Johnson 2023): features of places and times, and the
// gradients of planes and places.
#pragma once

#include <vector>

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr std::int64_t kHexPlanesPiece = 256;   // points per piece of work
constexpr std::int64_t kHexPlanesBlock = 2048;  // points whose gradients are kept at a time, before the planes add them up

// Where the four coordinates of a point lie on the cells of a level.
struct HexPlace {
  std::int32_t whole[4];
  float share[4], slope[4];  // slope: cells per unit of the coordinate, 0 at and beyond the border

  MUDG_INLINE void place(const float* point, const HexPlanesLevel& level) {
    for (int d = 0; d < 4; ++d) {
      const std::int32_t last = level.cells[d] - 1;
      const float given = point[d];
      const bool inside = given > -1.0f && given < 1.0f;
      const float at = ((given > -1.0f ? (given < 1.0f ? given : 1.0f) : -1.0f) + 1.0f) * 0.5f * static_cast<float>(last);
      std::int32_t first = static_cast<std::int32_t>(at);
      if (first > last - 1) first = last - 1;
      whole[d] = first;
      share[d] = at - static_cast<float>(first);
      slope[d] = inside ? 0.5f * static_cast<float>(last) : 0.0f;
    }
  }

  // Offset of the first of the four numbers' vectors in plane p of a level, and the step to the next row.
  MUDG_INLINE std::int64_t corner(int p, const HexPlanesLevel& level, std::int64_t features, std::int64_t& row) const {
    const int first = kHexAxes[p][0], second = kHexAxes[p][1];
    row = level.cells[first] * features;
    return level.offset[p] + whole[second] * row + whole[first] * features;
  }
};

template <int F>
MUDG_INLINE void hex_values(const HexPlanesJob& job, const HexPlanesLevel& level, const HexPlace& at, float (*value)[F]) {
  for (int p = 0; p < kHexPlanes; ++p) {
    std::int64_t row;
    const float* near = job.planes + at.corner(p, level, F, row);
    const float u = at.share[kHexAxes[p][0]], v = at.share[kHexAxes[p][1]];
    const float a = (1.0f - u) * (1.0f - v), b = u * (1.0f - v), c = (1.0f - u) * v, d = u * v;
    for (int f = 0; f < F; ++f) value[p][f] = a * near[f] + b * near[F + f] + c * near[row + f] + d * near[row + F + f];
  }
}

template <int F>
void hex_planes_features(const HexPlanesJob& job) {
  const std::int64_t width = static_cast<std::int64_t>(job.level_count) * F;
  parallel_for(job.points, kHexPlanesPiece, [&](std::int64_t begin, std::int64_t end, int) {
    for (int l = 0; l < job.level_count; ++l) {
      for (std::int64_t n = begin; n < end; ++n) {
        HexPlace at;
        at.place(job.x + n * 4, job.levels[l]);
        float value[kHexPlanes][F];
        hex_values<F>(job, job.levels[l], at, value);
        float* out = job.out + n * width + l * F;
        for (int f = 0; f < F; ++f) {
          out[f] = value[0][f] * value[1][f] * value[2][f] * value[3][f] * value[4][f] * value[5][f];
        }
      }
    }
  });
}

// What each plane of a level receives from the points of a block, [6][kHexPlanesBlock][F], and the gradients of the points.
template <int F>
void hex_planes_received(const HexPlanesJob& job, int l, std::int64_t from, std::int64_t to, float* received) {
  const HexPlanesLevel& level = job.levels[l];
  const std::int64_t width = static_cast<std::int64_t>(job.level_count) * F;
  parallel_for(to - from, kHexPlanesPiece, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t n = from + begin; n < from + end; ++n) {
      HexPlace at;
      at.place(job.x + n * 4, level);
      float value[kHexPlanes][F], before[kHexPlanes][F], after[F];
      hex_values<F>(job, level, at, value);
      const float* gradient = job.gradient + n * width + l * F;
      float mine[kHexPlanes][F];
      for (int f = 0; f < F; ++f) {
        before[0][f] = gradient[f];
        after[f] = 1.0f;
      }
      for (int p = 1; p < kHexPlanes; ++p)
        for (int f = 0; f < F; ++f) before[p][f] = before[p - 1][f] * value[p - 1][f];
      for (int p = kHexPlanes - 1; p >= 0; --p) {
        for (int f = 0; f < F; ++f) {
          mine[p][f] = before[p][f] * after[f];
          after[f] = after[f] * value[p][f];
        }
      }
      for (int p = 0; p < kHexPlanes; ++p)
        for (int f = 0; f < F; ++f) received[(p * kHexPlanesBlock + n - from) * F + f] = mine[p][f];
      if (job.of_x == nullptr) continue;
      float* of_x = job.of_x + n * 4;
      for (int p = 0; p < kHexPlanes; ++p) {
        const int first = kHexAxes[p][0], second = kHexAxes[p][1];
        std::int64_t row;
        const float* near = job.planes + at.corner(p, level, F, row);
        const float u = at.share[first], v = at.share[second];
        float along_f[F], across_f[F], along = 0.0f, across = 0.0f;
        for (int f = 0; f < F; ++f) {
          const float a = near[f], b = near[F + f], c = near[row + f], d = near[row + F + f];
          along_f[f] = mine[p][f] * ((1.0f - v) * (b - a) + v * (d - c));
          across_f[f] = mine[p][f] * ((1.0f - u) * (c - a) + u * (d - b));
        }
        for (int f = 0; f < F; ++f) along += along_f[f];
        for (int f = 0; f < F; ++f) across += across_f[f];
        of_x[first] += at.slope[first] * along;
        of_x[second] += at.slope[second] * across;
      }
    }
  });
}

// Every plane is one piece of work that adds its points up in their order: the sums do not depend on the number of threads.
template <int F>
void hex_planes_added(const HexPlanesJob& job, int l, std::int64_t from, std::int64_t to, const float* received) {
  const HexPlanesLevel& level = job.levels[l];
  parallel_for(kHexPlanes, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t p = begin; p < end; ++p) {
      const int first = kHexAxes[p][0], second = kHexAxes[p][1];
      const float* given = received + p * kHexPlanesBlock * F;
      for (std::int64_t n = from; n < to; ++n) {
        HexPlace at;
        at.place(job.x + n * 4, level);
        std::int64_t row;
        float* near = job.of_planes + at.corner(static_cast<int>(p), level, F, row);
        const float u = at.share[first], v = at.share[second];
        const float a = (1.0f - u) * (1.0f - v), b = u * (1.0f - v), c = (1.0f - u) * v, d = u * v;
        float mine[F];  // a copy, so that the compiler knows that it is not part of the plane
        for (int f = 0; f < F; ++f) mine[f] = given[(n - from) * F + f];
        for (int f = 0; f < F; ++f) near[f] += a * mine[f];
        for (int f = 0; f < F; ++f) near[F + f] += b * mine[f];
        for (int f = 0; f < F; ++f) near[row + f] += c * mine[f];
        for (int f = 0; f < F; ++f) near[row + F + f] += d * mine[f];
      }
    }
  });
}

template <int F>
void hex_planes_gradients(const HexPlanesJob& job) {
  std::vector<float> received(static_cast<std::size_t>(kHexPlanesBlock) * kHexPlanes * F);
  for (int l = 0; l < job.level_count; ++l) {
    for (std::int64_t from = 0; from < job.points; from += kHexPlanesBlock) {
      const std::int64_t to = smaller(job.points, from + kHexPlanesBlock);
      hex_planes_received<F>(job, l, from, to, received.data());
      if (job.of_planes != nullptr) hex_planes_added<F>(job, l, from, to, received.data());
    }
  }
}

template <int F>
void hex_planes_of(const HexPlanesJob& job) {
  if (job.out != nullptr) hex_planes_features<F>(job);
  if (job.of_planes != nullptr || job.of_x != nullptr) hex_planes_gradients<F>(job);
}

void hex_planes(const HexPlanesJob& job) {
  switch (job.features) {
    case 1: return hex_planes_of<1>(job);
    case 2: return hex_planes_of<2>(job);
    case 4: return hex_planes_of<4>(job);
    case 8: return hex_planes_of<8>(job);
    case 16: return hex_planes_of<16>(job);
    default: return hex_planes_of<32>(job);
  }
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
