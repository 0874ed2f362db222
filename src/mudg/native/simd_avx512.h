// Sixteen lanes in one AVX-512 register. See simd.h.
#pragma once

#include <immintrin.h>

namespace mudg::isa_avx512 {
namespace {

struct Mask {
  __mmask16 m;
};
struct Floats {
  __m512 v;
};
struct Ints {
  __m512i v;
};

MUDG_INLINE Floats splat(float x) { return {_mm512_set1_ps(x)}; }
MUDG_INLINE Ints splat_int(int x) { return {_mm512_set1_epi32(x)}; }
MUDG_INLINE Floats load(const float* p) { return {_mm512_load_ps(p)}; }
MUDG_INLINE Floats load_unaligned(const float* p) { return {_mm512_loadu_ps(p)}; }
MUDG_INLINE void store(float* p, Floats a) { _mm512_store_ps(p, a.v); }
MUDG_INLINE void store_unaligned(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
// The first `count` lanes only; lanes that are not loaded are 0.
MUDG_INLINE Floats load_first(const float* p, int count) {
  return {_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1u), p)};
}
MUDG_INLINE void store_first(float* p, int count, Floats a) {
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1u), a.v);
}
MUDG_INLINE Ints load_int(const int* p) { return {_mm512_load_si512(p)}; }
MUDG_INLINE void store_int(int* p, Ints a) { _mm512_store_si512(p, a.v); }

MUDG_INLINE Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
MUDG_INLINE Floats operator-(Floats a, Floats b) { return {_mm512_sub_ps(a.v, b.v)}; }
MUDG_INLINE Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
MUDG_INLINE Floats operator/(Floats a, Floats b) { return {_mm512_div_ps(a.v, b.v)}; }
MUDG_INLINE Floats mul_add(Floats a, Floats b, Floats c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
MUDG_INLINE Floats neg_mul_add(Floats a, Floats b, Floats c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
MUDG_INLINE Floats min_of(Floats a, Floats b) { return {_mm512_min_ps(a.v, b.v)}; }
MUDG_INLINE Floats max_of(Floats a, Floats b) { return {_mm512_max_ps(a.v, b.v)}; }
MUDG_INLINE Floats sqrt_of(Floats a) { return {_mm512_sqrt_ps(a.v)}; }
MUDG_INLINE Floats abs_of(Floats a) { return {_mm512_abs_ps(a.v)}; }
MUDG_INLINE Floats floor_of(Floats a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
MUDG_INLINE Floats ceil_of(Floats a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC)}; }
MUDG_INLINE Ints truncate(Floats a) { return {_mm512_cvttps_epi32(a.v)}; }

MUDG_INLINE Mask operator>=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
MUDG_INLINE Mask operator>(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
MUDG_INLINE Mask operator<=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
MUDG_INLINE Mask operator<(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
MUDG_INLINE Mask at_least(Ints a, Ints b) { return {_mm512_cmp_epi32_mask(a.v, b.v, _MM_CMPINT_NLT)}; }
MUDG_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
MUDG_INLINE unsigned bits(Mask a) { return a.m; }
MUDG_INLINE Floats select(Mask m, Floats yes, Floats no) { return {_mm512_mask_blend_ps(m.m, no.v, yes.v)}; }
MUDG_INLINE Floats keep(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m.m, a.v)}; }
MUDG_INLINE Ints select_int(Mask m, Ints yes, Ints no) { return {_mm512_mask_blend_epi32(m.m, no.v, yes.v)}; }

MUDG_INLINE float sum(Floats a) { return _mm512_reduce_add_ps(a.v); }

// 1 / a to about one unit in the last place.
MUDG_INLINE Floats reciprocal(Floats a) {
  const __m512 guess = _mm512_rcp14_ps(a.v);
  return {_mm512_fmadd_ps(guess, _mm512_fnmadd_ps(a.v, guess, _mm512_set1_ps(1.0f)), guess)};
}

constexpr int kGroup = 4;  // values worked on side by side, to hide latencies

// 2^x with a relative error below 1.3e-7, of a group.
MUDG_INLINE void exp2_group(const Floats* x, Floats* out) {
  constexpr float kSeries[] = {9.6715126e-3f, 5.5507337e-2f, 2.4022242e-1f, 6.9314698e-1f, 1.0f};
  __m512 whole[kGroup], part[kGroup], p[kGroup];
  for (int k = 0; k < kGroup; ++k)
    whole[k] = _mm512_roundscale_ps(x[k].v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  for (int k = 0; k < kGroup; ++k) part[k] = _mm512_sub_ps(x[k].v, whole[k]);
  for (int k = 0; k < kGroup; ++k) p[k] = _mm512_set1_ps(1.3264727e-3f);
  for (float coefficient : kSeries) {
    for (int k = 0; k < kGroup; ++k) p[k] = _mm512_fmadd_ps(p[k], part[k], _mm512_set1_ps(coefficient));
  }
  for (int k = 0; k < kGroup; ++k) out[k].v = _mm512_scalef_ps(p[k], whole[k]);
}

// x = mantissa * 2^exponent with the mantissa in [sqrt(1/2), sqrt(2)), roughly.
MUDG_INLINE void split_exponent(Floats x, Floats& exponent, Floats& mantissa) {
  const __m512 m = _mm512_getmant_ps(x.v, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_zero);
  const __m512 e = _mm512_getexp_ps(x.v);
  const __mmask16 halved = _mm512_cmp_ps_mask(m, _mm512_set1_ps(1.0f), _CMP_LT_OQ);
  mantissa.v = m;
  exponent.v = _mm512_mask_add_ps(e, halved, e, _mm512_set1_ps(1.0f));
}

}  // namespace
}  // namespace mudg::isa_avx512

// A stretch of a row of consecutive floats, for small matrix products (see accumulate_rows in raster_backward.h).
namespace mudg::isa_avx512 {
namespace {

struct WideRow {
  static constexpr int kWidth = 16, kRows = 16;  // floats, and how many rows fit into the registers
  __m512 v;
  static MUDG_INLINE WideRow load_row(const float* p) { return {_mm512_loadu_ps(p)}; }
  MUDG_INLINE void store_row(float* p) const { _mm512_storeu_ps(p, v); }
  static MUDG_INLINE WideRow product(float weight, WideRow row) {
    return {_mm512_mul_ps(_mm512_set1_ps(weight), row.v)};
  }
  MUDG_INLINE void add_product(float weight, WideRow row) { v = _mm512_fmadd_ps(_mm512_set1_ps(weight), row.v, v); }
  MUDG_INLINE WideRow plus(WideRow other) const { return {_mm512_add_ps(v, other.v)}; }
};

}  // namespace
}  // namespace mudg::isa_avx512
