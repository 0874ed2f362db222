// Point z-buffer: every point covers a small square of pixels, the nearest point wins, ties go to the lower index.
//
// A pixel is one 64-bit word, depth bits above the point's index: an atomic minimum keeps the result independent of the
// order in which threads arrive. Depths are positive, so their float bits order like the numbers themselves.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "api.h"
#include "parallel.h"

namespace {

constexpr std::uint64_t kEmpty = ~std::uint64_t{0};

inline void keep_nearest(std::atomic<std::uint64_t>& pixel, std::uint64_t key) {
  std::uint64_t seen = pixel.load(std::memory_order_relaxed);
  while (key < seen && !pixel.compare_exchange_weak(seen, key, std::memory_order_relaxed)) {
  }
}

// First pixel of the half-open interval of `side` pixels centred on `center`: pixel centres at +0.5, lower end excluded.
inline int first_pixel(float center, float side) { return static_cast<int>(std::floor(center - 0.5f * side - 0.5f)) + 1; }
inline int last_pixel(float center, float side) { return static_cast<int>(std::floor(center + 0.5f * side - 0.5f)); }

}  // namespace

extern "C" {

// Draws points xyz f32[count, 3] into keys. m: f32[12], cam_from_points, rows of [R | t]. intrinsics: fx, fy, cx, cy.
// Point i carries the index first_index + i; the caller keeps the sum below 2^32. The square of a point has a side of
// splat_pixels, or of splat_metres at its depth where that is not 0, between splat_pixels and splat_max_pixels.
MUDG_API void mudg_zbuffer_draw(const float* xyz, std::int64_t count, std::uint32_t first_index, const float* m,
                                const float* intrinsics, int width, int height, float splat_pixels, float splat_metres,
                                float splat_max_pixels, float near_m, float far_m, std::uint64_t* keys) {
  static_assert(sizeof(std::atomic<std::uint64_t>) == sizeof(std::uint64_t), "pixels are plain 64-bit words");
  auto* pixels = reinterpret_cast<std::atomic<std::uint64_t>*>(keys);
  const float fx = intrinsics[0], fy = intrinsics[1], cx = intrinsics[2], cy = intrinsics[3];
  mudg::parallel_for(count, 16384, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t i = begin; i < end; ++i) {
      const float x = xyz[3 * i], y = xyz[3 * i + 1], z = xyz[3 * i + 2];
      const float depth = ((m[8] * x + m[9] * y) + m[10] * z) + m[11];
      if (!(depth >= near_m && depth <= far_m)) continue;  // also drops NaN
      const float u = fx * (((m[0] * x + m[1] * y) + m[2] * z) + m[3]) / depth + cx;
      const float v = fy * (((m[4] * x + m[5] * y) + m[6] * z) + m[7]) / depth + cy;
      float side = splat_pixels;
      if (splat_metres > 0.0f) {
        side = fx * splat_metres / depth;
        if (side < splat_pixels) side = splat_pixels;
        if (side > splat_max_pixels) side = splat_max_pixels;
      }
      if (!(u > -side && v > -side && u < width + side && v < height + side)) continue;
      const int left = std::max(0, first_pixel(u, side)), right = std::min(width - 1, last_pixel(u, side));
      const int top = std::max(0, first_pixel(v, side)), bottom = std::min(height - 1, last_pixel(v, side));
      std::uint32_t bits;
      std::memcpy(&bits, &depth, sizeof bits);
      const std::uint64_t key = (std::uint64_t{bits} << 32) | (first_index + static_cast<std::uint32_t>(i));
      for (int row = top; row <= bottom; ++row)
        for (int column = left; column <= right; ++column) keep_nearest(pixels[static_cast<std::int64_t>(row) * width + column], key);
    }
  });
}

// Splits keys into depth f32[count] (0 = nothing) and index i32[count] (-1 = nothing).
MUDG_API void mudg_zbuffer_resolve(const std::uint64_t* keys, std::int64_t count, float* depth, std::int32_t* index) {
  mudg::parallel_for(count, 65536, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t i = begin; i < end; ++i) {
      const bool seen = keys[i] != kEmpty;
      const std::uint32_t bits = seen ? static_cast<std::uint32_t>(keys[i] >> 32) : 0u;
      std::memcpy(&depth[i], &bits, sizeof bits);
      index[i] = seen ? static_cast<std::int32_t>(keys[i] & 0xffffffffu) : -1;
    }
  });
}

// Fills planar colour f32[3, count] in [0, 1] at the pixels whose index lies in [first, first + points) from rgb u8[points, 3].
MUDG_API void mudg_zbuffer_color(const std::int32_t* index, std::int64_t count, const std::uint8_t* rgb, std::int64_t first,
                                 std::int64_t points, float* color) {
  mudg::parallel_for(count, 65536, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t point = index[i] - first;
      if (index[i] < 0 || point < 0 || point >= points) continue;
      for (int channel = 0; channel < 3; ++channel) color[channel * count + i] = static_cast<float>(rgb[3 * point + channel]) / 255.0f;
    }
  });
}

}  // extern "C"
