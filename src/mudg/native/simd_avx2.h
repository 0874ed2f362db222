// Sixteen lanes in two AVX2 registers. See simd.h.
#pragma once

#include <immintrin.h>

namespace mudg::isa_avx2 {
namespace {

struct Mask {
  __m256 a, b;
};
struct Floats {
  __m256 a, b;
};
struct Ints {
  __m256i a, b;
};

MUDG_INLINE Floats splat(float x) {
  const __m256 v = _mm256_set1_ps(x);
  return {v, v};
}
MUDG_INLINE Ints splat_int(int x) {
  const __m256i v = _mm256_set1_epi32(x);
  return {v, v};
}
MUDG_INLINE Floats load(const float* p) { return {_mm256_load_ps(p), _mm256_load_ps(p + 8)}; }
MUDG_INLINE Floats load_unaligned(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
MUDG_INLINE void store(float* p, Floats x) {
  _mm256_store_ps(p, x.a);
  _mm256_store_ps(p + 8, x.b);
}
MUDG_INLINE void store_unaligned(float* p, Floats x) {
  _mm256_storeu_ps(p, x.a);
  _mm256_storeu_ps(p + 8, x.b);
}
// The first `count` lanes only; lanes that are not loaded are 0.
MUDG_INLINE __m256i first_eight(int count) {
  return _mm256_cmpgt_epi32(_mm256_set1_epi32(count), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
}
MUDG_INLINE Floats load_first(const float* p, int count) {
  return {_mm256_maskload_ps(p, first_eight(count)), _mm256_maskload_ps(p + 8, first_eight(count - 8))};
}
MUDG_INLINE void store_first(float* p, int count, Floats x) {
  _mm256_maskstore_ps(p, first_eight(count), x.a);
  _mm256_maskstore_ps(p + 8, first_eight(count - 8), x.b);
}
MUDG_INLINE Ints load_int(const int* p) {
  return {_mm256_load_si256(reinterpret_cast<const __m256i*>(p)),
          _mm256_load_si256(reinterpret_cast<const __m256i*>(p + 8))};
}
MUDG_INLINE void store_int(int* p, Ints x) {
  _mm256_store_si256(reinterpret_cast<__m256i*>(p), x.a);
  _mm256_store_si256(reinterpret_cast<__m256i*>(p + 8), x.b);
}

MUDG_INLINE Floats operator+(Floats x, Floats y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
MUDG_INLINE Floats operator-(Floats x, Floats y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
MUDG_INLINE Floats operator*(Floats x, Floats y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
MUDG_INLINE Floats operator/(Floats x, Floats y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
MUDG_INLINE Floats mul_add(Floats x, Floats y, Floats z) {
  return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
}
MUDG_INLINE Floats neg_mul_add(Floats x, Floats y, Floats z) {
  return {_mm256_fnmadd_ps(x.a, y.a, z.a), _mm256_fnmadd_ps(x.b, y.b, z.b)};
}
MUDG_INLINE Floats min_of(Floats x, Floats y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
MUDG_INLINE Floats max_of(Floats x, Floats y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
MUDG_INLINE Floats sqrt_of(Floats x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
MUDG_INLINE Floats abs_of(Floats x) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(sign, x.a), _mm256_andnot_ps(sign, x.b)};
}
MUDG_INLINE Floats floor_of(Floats x) { return {_mm256_floor_ps(x.a), _mm256_floor_ps(x.b)}; }
MUDG_INLINE Floats ceil_of(Floats x) { return {_mm256_ceil_ps(x.a), _mm256_ceil_ps(x.b)}; }
MUDG_INLINE Ints truncate(Floats x) { return {_mm256_cvttps_epi32(x.a), _mm256_cvttps_epi32(x.b)}; }

MUDG_INLINE Mask operator>=(Floats x, Floats y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)};
}
MUDG_INLINE Mask operator>(Floats x, Floats y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GT_OQ)};
}
MUDG_INLINE Mask operator<=(Floats x, Floats y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LE_OQ)};
}
MUDG_INLINE Mask operator<(Floats x, Floats y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_LT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LT_OQ)};
}
MUDG_INLINE Mask at_least(Ints x, Ints y) {
  const __m256i ones = _mm256_set1_epi32(-1);
  return {_mm256_castsi256_ps(_mm256_xor_si256(_mm256_cmpgt_epi32(y.a, x.a), ones)),
          _mm256_castsi256_ps(_mm256_xor_si256(_mm256_cmpgt_epi32(y.b, x.b), ones))};
}
MUDG_INLINE Mask operator&(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
MUDG_INLINE unsigned bits(Mask x) {
  return static_cast<unsigned>(_mm256_movemask_ps(x.a)) | (static_cast<unsigned>(_mm256_movemask_ps(x.b)) << 8);
}
MUDG_INLINE Floats select(Mask m, Floats yes, Floats no) {
  return {_mm256_blendv_ps(no.a, yes.a, m.a), _mm256_blendv_ps(no.b, yes.b, m.b)};
}
MUDG_INLINE Floats keep(Mask m, Floats x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
MUDG_INLINE Ints select_int(Mask m, Ints yes, Ints no) {
  return {_mm256_blendv_epi8(no.a, yes.a, _mm256_castps_si256(m.a)),
          _mm256_blendv_epi8(no.b, yes.b, _mm256_castps_si256(m.b))};
}

MUDG_INLINE float sum(Floats x) {
  const __m256 pair = _mm256_add_ps(x.a, x.b);
  __m128 t = _mm_add_ps(_mm256_castps256_ps128(pair), _mm256_extractf128_ps(pair, 1));
  t = _mm_add_ps(t, _mm_movehl_ps(t, t));
  t = _mm_add_ss(t, _mm_movehdup_ps(t));
  return _mm_cvtss_f32(t);
}

MUDG_INLINE Floats reciprocal(Floats x) { return splat(1.0f) / x; }

MUDG_INLINE __m256 exp2_half(__m256 x) {
  const __m256 whole = _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  const __m256 part = _mm256_sub_ps(x, whole);
  __m256 p = _mm256_set1_ps(1.3264727e-3f);
  p = _mm256_fmadd_ps(p, part, _mm256_set1_ps(9.6715126e-3f));
  p = _mm256_fmadd_ps(p, part, _mm256_set1_ps(5.5507337e-2f));
  p = _mm256_fmadd_ps(p, part, _mm256_set1_ps(2.4022242e-1f));
  p = _mm256_fmadd_ps(p, part, _mm256_set1_ps(6.9314698e-1f));
  p = _mm256_fmadd_ps(p, part, _mm256_set1_ps(1.0f));
  const __m256i exponent = _mm256_slli_epi32(_mm256_cvtps_epi32(whole), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), exponent));
}

constexpr int kGroup = 2;  // values worked on side by side, to hide latencies

// 2^x with a relative error below 1.3e-7, of a group; meaningless below -126.
MUDG_INLINE void exp2_group(const Floats* x, Floats* out) {
  for (int k = 0; k < kGroup; ++k) out[k] = {exp2_half(x[k].a), exp2_half(x[k].b)};
}

MUDG_INLINE void split_exponent_half(__m256 x, __m256& exponent, __m256& mantissa) {
  const __m256i raw = _mm256_castps_si256(x);
  const __m256i e = _mm256_srai_epi32(_mm256_sub_epi32(raw, _mm256_set1_epi32(0x3f3504f3)), 23);
  exponent = _mm256_cvtepi32_ps(e);
  mantissa = _mm256_castsi256_ps(_mm256_sub_epi32(raw, _mm256_slli_epi32(e, 23)));
}

// x = mantissa * 2^exponent with the mantissa in [sqrt(1/2), sqrt(2)).
MUDG_INLINE void split_exponent(Floats x, Floats& exponent, Floats& mantissa) {
  split_exponent_half(x.a, exponent.a, mantissa.a);
  split_exponent_half(x.b, exponent.b, mantissa.b);
}

}  // namespace
}  // namespace mudg::isa_avx2

// A stretch of a row of consecutive floats, for small matrix products (see accumulate_rows in raster_backward.h).
namespace mudg::isa_avx2 {
namespace {

struct WideRow {
  static constexpr int kWidth = 8, kRows = 8;  // floats, and how many rows fit into the registers
  __m256 v;
  static MUDG_INLINE WideRow load_row(const float* p) { return {_mm256_loadu_ps(p)}; }
  MUDG_INLINE void store_row(float* p) const { _mm256_storeu_ps(p, v); }
  static MUDG_INLINE WideRow product(float weight, WideRow row) {
    return {_mm256_mul_ps(_mm256_set1_ps(weight), row.v)};
  }
  MUDG_INLINE void add_product(float weight, WideRow row) { v = _mm256_fmadd_ps(_mm256_set1_ps(weight), row.v, v); }
  MUDG_INLINE WideRow plus(WideRow other) const { return {_mm256_add_ps(v, other.v)}; }
};
using NarrowRow = WideRow;

}  // namespace
}  // namespace mudg::isa_avx2
