// Sixteen float lanes under one name, in three implementations. The file that is compiled with AVX-512 flags gets one
// register, the one with AVX2 flags two, and every other processor four 128-bit vectors through compiler vector
// extensions.
//
// Everything here lives in a namespace named after the instruction set and inside an anonymous namespace: an inline
// function with external linkage would be merged by the linker across instruction sets, and then run on a processor
// without it.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#define MUDG_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define MUDG_ISA_NAMESPACE isa_avx512
#include "simd_avx512.h"
#elif defined(__AVX2__) && defined(__FMA__)
#define MUDG_ISA_NAMESPACE isa_avx2
#include "simd_avx2.h"
#else
#define MUDG_ISA_NAMESPACE isa_portable
#include "simd_portable.h"
#endif

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kLanes = 16;
alignas(64) constexpr float kLaneIndex[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// log2(x) to about one unit in the last place, for normal positive x. The logarithm of the mantissa m in [sqrt(1/2),
// sqrt(2)) is the odd series in (m - 1) / (m + 1).
MUDG_INLINE Floats log2_of(Floats x) {
  Floats exponent, mantissa;
  split_exponent(x, exponent, mantissa);
  const Floats ratio = (mantissa - splat(1.0f)) / (mantissa + splat(1.0f));
  const Floats square = ratio * ratio;
  Floats series = mul_add(square, splat(0.3205986f), splat(0.41219858f));
  series = mul_add(square, series, splat(0.57707802f));
  series = mul_add(square, series, splat(0.96179669f));
  series = mul_add(square, series, splat(2.88539008f));
  return mul_add(ratio, series, exponent);
}

// As load_first and store_first, without a mask where all lanes are meant.
MUDG_INLINE Floats load_up_to(const float* p, int count) {
  return count == kLanes ? load_unaligned(p) : load_first(p, count);
}
MUDG_INLINE void store_up_to(float* p, int count, Floats x) {
  if (count == kLanes) return store_unaligned(p, x);
  store_first(p, count, x);
}

// First `count` lanes set.
MUDG_INLINE Mask first_lanes(int count) { return load(kLaneIndex) < splat(static_cast<float>(count)); }

template <class T>
MUDG_INLINE T smaller(T a, T b) {
  return b < a ? b : a;
}
template <class T>
MUDG_INLINE T larger(T a, T b) {
  return a < b ? b : a;
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
