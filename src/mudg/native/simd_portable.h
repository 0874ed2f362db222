// Sixteen lanes as four 128-bit vectors, through the vector extensions of GCC and Clang: SSE2, NEON and whatever comes.
// See simd.h. mul_add is fused only where the baseline has it (NEON).
#pragma once

#if defined(__SSE2__)
#include <emmintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace mudg::isa_portable {
namespace {

typedef float Quad __attribute__((vector_size(16)));
typedef int QuadInt __attribute__((vector_size(16)));

struct Mask {
  QuadInt q[4];
};
struct Floats {
  Quad q[4];
};
struct Ints {
  QuadInt q[4];
};

MUDG_INLINE QuadInt as_int(Quad a) { return reinterpret_cast<QuadInt>(a); }
MUDG_INLINE Quad as_float(QuadInt a) { return reinterpret_cast<Quad>(a); }
MUDG_INLINE Quad load_quad(const float* p) {
  Quad v;
  std::memcpy(&v, p, 16);
  return v;
}
MUDG_INLINE QuadInt load_quad(const int* p) {
  QuadInt v;
  std::memcpy(&v, p, 16);
  return v;
}

MUDG_INLINE Floats splat(float x) {
  const Quad v = {x, x, x, x};
  return {{v, v, v, v}};
}
MUDG_INLINE Ints splat_int(int x) {
  const QuadInt v = {x, x, x, x};
  return {{v, v, v, v}};
}
MUDG_INLINE Floats load_unaligned(const float* p) {
  return {{load_quad(p), load_quad(p + 4), load_quad(p + 8), load_quad(p + 12)}};
}
MUDG_INLINE Floats load(const float* p) { return load_unaligned(p); }
MUDG_INLINE void store_unaligned(float* p, Floats a) { std::memcpy(p, a.q, 64); }
MUDG_INLINE void store(float* p, Floats a) { store_unaligned(p, a); }
// The first `count` lanes only; lanes that are not loaded are 0.
MUDG_INLINE Floats load_first(const float* p, int count) {
  float all[16] = {};
  std::memcpy(all, p, sizeof(float) * static_cast<std::size_t>(count));
  return load_unaligned(all);
}
MUDG_INLINE void store_first(float* p, int count, Floats a) {
  std::memcpy(p, a.q, sizeof(float) * static_cast<std::size_t>(count));
}
MUDG_INLINE Ints load_int(const int* p) {
  return {{load_quad(p), load_quad(p + 4), load_quad(p + 8), load_quad(p + 12)}};
}
MUDG_INLINE void store_int(int* p, Ints a) { std::memcpy(p, a.q, 64); }

// {f(0), f(1), f(2), f(3)}: a function of each of the four vectors.
template <class Lanes, class Function>
MUDG_INLINE Lanes lanewise(const Function& f) {
  return {{f(0), f(1), f(2), f(3)}};
}
#define MUDG_BINARY(Type, name, op)                                                    \
  MUDG_INLINE Type name(Type a, Type b) {                                              \
    return {{a.q[0] op b.q[0], a.q[1] op b.q[1], a.q[2] op b.q[2], a.q[3] op b.q[3]}}; \
  }
#define MUDG_COMPARE(name, op)                                                         \
  MUDG_INLINE Mask name(Floats a, Floats b) {                                          \
    return {{a.q[0] op b.q[0], a.q[1] op b.q[1], a.q[2] op b.q[2], a.q[3] op b.q[3]}}; \
  }
MUDG_BINARY(Floats, operator+, +)
MUDG_BINARY(Floats, operator-, -)
MUDG_BINARY(Floats, operator*, *)
MUDG_BINARY(Floats, operator/, /)
MUDG_BINARY(Mask, operator&, &)
MUDG_COMPARE(operator>=, >=)
MUDG_COMPARE(operator>, >)
MUDG_COMPARE(operator<=, <=)
MUDG_COMPARE(operator<, <)
#undef MUDG_BINARY
#undef MUDG_COMPARE

MUDG_INLINE Mask at_least(Ints a, Ints b) {
  return lanewise<Mask>([&](int k) { return a.q[k] >= b.q[k]; });
}
MUDG_INLINE Floats mul_add(Floats a, Floats b, Floats c) {
#if defined(__aarch64__)
  return lanewise<Floats>([&](int k) {
    return reinterpret_cast<Quad>(vfmaq_f32((float32x4_t)c.q[k], (float32x4_t)a.q[k], (float32x4_t)b.q[k]));
  });
#else
  return lanewise<Floats>([&](int k) { return a.q[k] * b.q[k] + c.q[k]; });
#endif
}
MUDG_INLINE Floats neg_mul_add(Floats a, Floats b, Floats c) {
#if defined(__aarch64__)
  return lanewise<Floats>([&](int k) {
    return reinterpret_cast<Quad>(vfmsq_f32((float32x4_t)c.q[k], (float32x4_t)a.q[k], (float32x4_t)b.q[k]));
  });
#else
  return lanewise<Floats>([&](int k) { return c.q[k] - a.q[k] * b.q[k]; });
#endif
}

MUDG_INLINE Quad select_quad(QuadInt m, Quad yes, Quad no) { return as_float((as_int(yes) & m) | (as_int(no) & ~m)); }
MUDG_INLINE Floats select(Mask m, Floats yes, Floats no) {
  return lanewise<Floats>([&](int k) { return select_quad(m.q[k], yes.q[k], no.q[k]); });
}
MUDG_INLINE Floats keep(Mask m, Floats a) {
  return lanewise<Floats>([&](int k) { return as_float(as_int(a.q[k]) & m.q[k]); });
}
MUDG_INLINE Ints select_int(Mask m, Ints yes, Ints no) {
  return lanewise<Ints>([&](int k) { return (yes.q[k] & m.q[k]) | (no.q[k] & ~m.q[k]); });
}

// As on x86, the second argument is the answer when either is NaN.
#if defined(__SSE2__)
MUDG_INLINE Floats min_of(Floats a, Floats b) {
  return lanewise<Floats>([&](int k) { return _mm_min_ps(a.q[k], b.q[k]); });
}
MUDG_INLINE Floats max_of(Floats a, Floats b) {
  return lanewise<Floats>([&](int k) { return _mm_max_ps(a.q[k], b.q[k]); });
}
MUDG_INLINE unsigned bits(Mask a) {
  return static_cast<unsigned>(_mm_movemask_ps(as_float(a.q[0])) | _mm_movemask_ps(as_float(a.q[1])) << 4 |
                               _mm_movemask_ps(as_float(a.q[2])) << 8 | _mm_movemask_ps(as_float(a.q[3])) << 12);
}
#else
MUDG_INLINE Floats min_of(Floats a, Floats b) { return select(a < b, a, b); }
MUDG_INLINE Floats max_of(Floats a, Floats b) { return select(a > b, a, b); }
MUDG_INLINE unsigned bits(Mask a) {
  unsigned result = 0;
  for (int k = 0; k < 4; ++k)
    for (int i = 0; i < 4; ++i) result |= static_cast<unsigned>(a.q[k][i] & 1) << (k * 4 + i);
  return result;
}
#endif

MUDG_INLINE Quad sqrt_quad(Quad a) {
#if defined(__SSE2__)
  return _mm_sqrt_ps(a);
#elif defined(__aarch64__)
  return reinterpret_cast<Quad>(vsqrtq_f32((float32x4_t)a));
#else
  for (int i = 0; i < 4; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
#endif
}
MUDG_INLINE Floats sqrt_of(Floats a) {
  return lanewise<Floats>([&](int k) { return sqrt_quad(a.q[k]); });
}
MUDG_INLINE Floats abs_of(Floats a) {
  const QuadInt magnitude = {0x7fffffff, 0x7fffffff, 0x7fffffff, 0x7fffffff};
  return lanewise<Floats>([&](int k) { return as_float(as_int(a.q[k]) & magnitude); });
}
MUDG_INLINE Ints truncate(Floats a) {
  return lanewise<Ints>([&](int k) { return __builtin_convertvector(a.q[k], QuadInt); });
}
MUDG_INLINE Floats to_float(Ints a) {
  return lanewise<Floats>([&](int k) { return __builtin_convertvector(a.q[k], Quad); });
}
// Valid for |a| < 2^31, which holds for pixel coordinates after clamping.
MUDG_INLINE Floats floor_of(Floats a) {
  const Floats whole = to_float(truncate(a));
  return select(whole > a, whole - splat(1.0f), whole);
}
MUDG_INLINE Floats ceil_of(Floats a) {
  const Floats whole = to_float(truncate(a));
  return select(whole < a, whole + splat(1.0f), whole);
}

MUDG_INLINE float sum(Floats a) {
  const Quad s = (a.q[0] + a.q[1]) + (a.q[2] + a.q[3]);
  return (s[0] + s[1]) + (s[2] + s[3]);
}

MUDG_INLINE Floats reciprocal(Floats a) { return splat(1.0f) / a; }

MUDG_INLINE Quad exp2_quad(Quad x) {
  const float rounder = 12582912.0f;  // 1.5 * 2^23: adding and subtracting it rounds to the nearest integer
  const Quad whole = (x + rounder) - rounder;
  const Quad part = x - whole;
  Quad p = part * 1.3264727e-3f + 9.6715126e-3f;
  p = p * part + 5.5507337e-2f;
  p = p * part + 2.4022242e-1f;
  p = p * part + 6.9314698e-1f;
  p = p * part + 1.0f;
  return as_float(as_int(p) + (__builtin_convertvector(whole, QuadInt) << 23));
}

constexpr int kGroup = 1;  // values worked on side by side

// 2^x with a relative error below 2e-7; x below -126 counts as -126.
MUDG_INLINE void exp2_group(const Floats* x, Floats* out) {
  const Floats held = max_of(x[0], splat(-126.0f));
  out[0] = lanewise<Floats>([&](int k) { return exp2_quad(held.q[k]); });
}

// x = mantissa * 2^exponent with the mantissa in [sqrt(1/2), sqrt(2)).
MUDG_INLINE void split_exponent(Floats x, Floats& exponent, Floats& mantissa) {
  for (int k = 0; k < 4; ++k) {
    const QuadInt e = (as_int(x.q[k]) - 0x3f3504f3) >> 23;
    exponent.q[k] = __builtin_convertvector(e, Quad);
    mantissa.q[k] = as_float(as_int(x.q[k]) - (e << 23));
  }
}

}  // namespace
}  // namespace mudg::isa_portable

// A stretch of a row of consecutive floats, for small matrix products (see accumulate_rows in raster_backward.h).
namespace mudg::isa_portable {
namespace {

struct WideRow {
  static constexpr int kWidth = 4, kRows = 8;  // floats, and how many rows fit into the registers
  Quad v;
  static MUDG_INLINE WideRow load_row(const float* p) { return {load_quad(p)}; }
  MUDG_INLINE void store_row(float* p) const { std::memcpy(p, &v, 16); }
  static MUDG_INLINE WideRow product(float weight, WideRow row) { return {row.v * weight}; }
  MUDG_INLINE void add_product(float weight, WideRow row) { v += row.v * weight; }
  MUDG_INLINE WideRow plus(WideRow other) const { return {v + other.v}; }
};
using NarrowRow = WideRow;

}  // namespace
}  // namespace mudg::isa_portable
