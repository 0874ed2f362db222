// Real spherical harmonics up to degree 3 in the order and with the signs that Gaussian splatting uses, and their
// derivative.
#pragma once

#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kMaxSh = 16;

// basis[count], count = (degree + 1)^2, at the unit direction (x, y, z).
MUDG_INLINE void sh_basis(int count, Floats x, Floats y, Floats z, Floats* basis) {
  basis[0] = splat(0.2820947917738781f);
  if (count == 1) return;
  basis[1] = splat(-0.48860251190292f) * y;
  basis[2] = splat(0.48860251190292f) * z;
  basis[3] = splat(-0.48860251190292f) * x;
  if (count == 4) return;
  const Floats zz = z * z, cos2 = x * x - y * y, sin2 = splat(2.0f) * x * y;
  const Floats slope = splat(-1.092548430592079f) * z;
  const Floats a = splat(0.5462742152960395f);
  basis[4] = a * sin2;
  basis[5] = slope * y;
  basis[6] = splat(0.9461746957575601f) * zz - splat(0.3153915652525201f);
  basis[7] = slope * x;
  basis[8] = a * cos2;
  if (count == 9) return;
  const Floats c = splat(0.4570457994644658f) - splat(2.285228997322329f) * zz;
  const Floats d = splat(1.445305721320277f) * z;
  const Floats e = splat(-0.5900435899266435f);
  const Floats cos3 = x * cos2 - y * sin2, sin3 = x * sin2 + y * cos2;
  basis[9] = e * sin3;
  basis[10] = d * sin2;
  basis[11] = c * y;
  basis[12] = z * (splat(1.865881662950577f) * zz - splat(1.119528997770346f));
  basis[13] = c * x;
  basis[14] = d * cos2;
  basis[15] = e * cos3;
}

// Gradient of sum_k weight[k] * basis_k with respect to the direction, before the projection onto the unit sphere.
// `count` is above 1.
MUDG_INLINE void sh_basis_backward(int count, Floats x, Floats y, Floats z, const Floats* weight, Floats* direction) {
  const auto number = [](float value) { return splat(value); };
  direction[0] = number(-0.48860251190292f) * weight[3];
  direction[1] = number(-0.48860251190292f) * weight[1];
  direction[2] = number(0.48860251190292f) * weight[2];
  if (count == 4) return;
  const Floats two = number(2.0f), x2 = two * x, y2 = two * y;
  const Floats cos2 = x * x - y * y, sin2 = x2 * y;
  const Floats slope = number(-1.092548430592079f), a = number(0.5462742152960395f);
  direction[0] = direction[0] + slope * z * weight[7] + a * (x2 * weight[8] + y2 * weight[4]);
  direction[1] = direction[1] + slope * z * weight[5] + a * (x2 * weight[4] - y2 * weight[8]);
  direction[2] = direction[2] + number(2.0f * 0.9461746957575601f) * z * weight[6] +
                 slope * (x * weight[7] + y * weight[5]);
  if (count == 9) return;
  const Floats c = number(0.4570457994644658f) - number(2.285228997322329f) * z * z;
  const Floats c_dz = number(-2.0f * 2.285228997322329f) * z;
  const Floats d = number(1.445305721320277f), e = number(-3.0f * 0.5900435899266435f);
  direction[0] = direction[0] + c * weight[13] + d * z * (x2 * weight[14] + y2 * weight[10]) +
                 e * (cos2 * weight[15] + sin2 * weight[9]);
  direction[1] = direction[1] + c * weight[11] + d * z * (x2 * weight[10] - y2 * weight[14]) +
                 e * (cos2 * weight[9] - sin2 * weight[15]);
  direction[2] = direction[2] + (number(3.0f * 1.865881662950577f) * z * z - number(1.119528997770346f)) * weight[12] +
                 c_dz * (x * weight[13] + y * weight[11]) + d * (cos2 * weight[14] + sin2 * weight[10]);
}

// color[3] = 0.5 + sum_k basis[k * stride] * row k, rows of three: `first`, then those of `rest`.
#if defined(__AVX2__)
MUDG_INLINE void sh_color(const float* first, const float* rest, const float* basis, int stride, int count,
                          float* color) {
  // Four rows at a time, those of `rest` loaded with one float too many: the last row is left to the scalar loop.
  const float* sh = rest - 3;
  __m128 sums[4] = {_mm_set1_ps(0.5f), _mm_setzero_ps(), _mm_setzero_ps(), _mm_setzero_ps()};
  int k = 0;
  for (; k + 5 <= count; k += 4) {
    for (int j = 0; j < 4; ++j) {
      if (k + j == 0) {
        sums[0] = _mm_fmadd_ps(_mm_set1_ps(basis[0]), _mm_setr_ps(first[0], first[1], first[2], 0.0f), sums[0]);
        continue;
      }
      sums[j] = _mm_fmadd_ps(_mm_set1_ps(basis[(k + j) * stride]), _mm_loadu_ps(sh + 3 * (k + j)), sums[j]);
    }
  }
  alignas(16) float total[4];
  _mm_store_ps(total, _mm_add_ps(_mm_add_ps(sums[0], sums[1]), _mm_add_ps(sums[2], sums[3])));
  for (; k < count; ++k) {
    const float* row = k == 0 ? first : sh + 3 * k;
    for (int c = 0; c < 3; ++c) total[c] += basis[k * stride] * row[c];
  }
  for (int c = 0; c < 3; ++c) color[c] = total[c];
}
#else
MUDG_INLINE void sh_color(const float* first, const float* rest, const float* basis, int stride, int count,
                          float* color) {
  float red = 0.5f, green = 0.5f, blue = 0.5f;
  for (int k = 0; k < count; ++k) {
    const float weight = basis[k * stride];
    const float* row = k == 0 ? first : rest + 3 * (k - 1);
    red += weight * row[0];
    green += weight * row[1];
    blue += weight * row[2];
  }
  color[0] = red;
  color[1] = green;
  color[2] = blue;
}
#endif

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
