// Small vectors, integer hashes and value noise for the procedural city. No state, no allocation.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

namespace mudg::city {

constexpr float kPi = 3.14159265358979f;
constexpr float kInf = 1e30f;

struct Vec3 {
  float x = 0, y = 0, z = 0;
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline Vec3 operator*(Vec3 a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec3 operator*(float s, Vec3 a) { return a * s; }
inline Vec3& operator+=(Vec3& a, Vec3 b) { a = a + b; return a; }
inline Vec3& operator*=(Vec3& a, float s) { a = a * s; return a; }
inline float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float length(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalize(Vec3 a) {
  const float n = dot(a, a);
  return n > 0 ? a * (1.0f / std::sqrt(n)) : Vec3{0, 0, 1};
}
inline Vec3 mix(Vec3 a, Vec3 b, float t) { return a + (b - a) * t; }
inline float mix(float a, float b, float t) { return a + (b - a) * t; }
inline float clamp01(float v) { return v < 0 ? 0 : (v > 1 ? 1 : v); }
inline float smoothstep(float a, float b, float v) {
  const float t = clamp01((v - a) / (b - a));
  return t * t * (3 - 2 * t);
}
inline float fract(float v) { return v - std::floor(v); }
inline float square(float v) { return v * v; }
// floor to int without a library call (valid for |v| < 2^31)
inline int ifloor(float v) {
  const int i = static_cast<int>(v);
  return i - (v < static_cast<float>(i));
}

inline uint32_t mix_bits(uint32_t h) {
  h ^= h >> 16;
  h *= 0x7feb352du;
  h ^= h >> 15;
  h *= 0x846ca68bu;
  h ^= h >> 16;
  return h;
}
inline uint32_t hash_bits(int a, int b, int c) {
  return mix_bits(static_cast<uint32_t>(a) * 0x9e3779b1u ^ (static_cast<uint32_t>(b) * 0x85ebca77u + 0x165667b1u) ^
                  static_cast<uint32_t>(c) * 0xc2b2ae3du);
}
inline uint32_t hash_bits(int a, int b, int c, int d) {
  return mix_bits(hash_bits(a, b, c) + static_cast<uint32_t>(d) * 0x27d4eb2fu);
}
inline float unit(uint32_t h) { return static_cast<float>(h >> 8) * (1.0f / 16777216.0f); }
inline float hash01(int a, int b, int c) { return unit(hash_bits(a, b, c)); }

// Value noise in [0,1], smooth, period none.
inline float noise2(float x, float y, int seed) {
  const int xi = ifloor(x), yi = ifloor(y);
  float fx = x - xi, fy = y - yi;
  fx = fx * fx * (3 - 2 * fx);
  fy = fy * fy * (3 - 2 * fy);
  const float a = hash01(xi, yi, seed), b = hash01(xi + 1, yi, seed);
  const float c = hash01(xi, yi + 1, seed), d = hash01(xi + 1, yi + 1, seed);
  return a + (b - a) * fx + (c - a) * fy + (a - b - c + d) * fx * fy;
}

// Noise around zero in [-0.5,0.5] whose octaves fade when the pixel footprint (same unit as x) exceeds their wavelength.
inline float noise_filtered(float x, float y, float frequency, float footprint, int seed) {
  const float weight = clamp01(1.35f - footprint * frequency);
  return weight <= 0 ? 0 : weight * (noise2(x * frequency, y * frequency, seed) - 0.5f);
}
inline float fbm_filtered(float x, float y, float frequency, float footprint, int seed) {
  return 0.55f * noise_filtered(x, y, frequency, footprint, seed) +
         0.30f * noise_filtered(y + 3.7f, x + 1.3f, frequency * 2.17f, footprint, seed + 1) +
         0.20f * noise_filtered(x + 9.1f, y + 5.7f, frequency * 4.61f, footprint, seed + 2);
}

// Small counter generator for building objects: same seed, same draws.
struct Draws {
  uint32_t state;
  explicit Draws(uint32_t seed) : state(mix_bits(seed + 0x51ed270bu)) {}
  float operator()() {
    state += 0x9e3779b9u;
    return unit(mix_bits(state));
  }
  float operator()(float a, float b) { return a + (b - a) * (*this)(); }
  int below(int n) { return std::min(n - 1, static_cast<int>((*this)() * n)); }
};

struct Aabb {
  Vec3 lo{kInf, kInf, kInf}, hi{-kInf, -kInf, -kInf};
  void grow(Vec3 p) {
    lo = {std::min(lo.x, p.x), std::min(lo.y, p.y), std::min(lo.z, p.z)};
    hi = {std::max(hi.x, p.x), std::max(hi.y, p.y), std::max(hi.z, p.z)};
  }
  void grow(const Aabb& b) {
    grow(b.lo);
    grow(b.hi);
  }
  float half_area() const {
    const Vec3 e = hi - lo;
    return e.x < 0 ? 0 : e.x * e.y + e.y * e.z + e.z * e.x;
  }
};

}  // namespace mudg::city
