// Point z-buffer: every point covers a small square of pixels, the nearest point wins, ties go to the lower index.
//
// A pixel is one 64-bit word, depth bits above the point's index: an atomic minimum keeps the result independent of the
// order in which threads arrive. Depths are positive, so their float bits order like the numbers themselves.
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "api.h"
#include "parallel.h"

namespace {

constexpr std::uint64_t kEmpty = ~std::uint64_t{0};

struct Camera {
  float rotation[9];  // cam_from_world, row major
  float translation[3];
  float fx, fy, cx, cy;
  int width, height;
};

struct Splat {
  float pixels;      // side of the square in pixels; used when metres is 0
  float metres;      // side of the square in metres at the point's depth
  float max_pixels;  // upper limit of the side
};

inline void keep_nearest(std::atomic<std::uint64_t>& pixel, std::uint64_t key) {
  std::uint64_t seen = pixel.load(std::memory_order_relaxed);
  while (key < seen && !pixel.compare_exchange_weak(seen, key, std::memory_order_relaxed)) {
  }
}

// First pixel of the half-open interval of `side` pixels centred on `center`: pixel centres at +0.5, lower end excluded.
inline int first_pixel(float center, float side) { return static_cast<int>(std::floor(center - 0.5f * side - 0.5f)) + 1; }
inline int last_pixel(float center, float side) { return static_cast<int>(std::floor(center + 0.5f * side - 0.5f)); }

void draw(const float* xyz, std::int64_t begin, std::int64_t end, std::uint32_t first_index, const Camera& c,
          const Splat& splat, float near_m, float far_m, std::atomic<std::uint64_t>* keys) {
  const float* r = c.rotation;
  for (std::int64_t i = begin; i < end; ++i) {
    const float x = xyz[3 * i], y = xyz[3 * i + 1], z = xyz[3 * i + 2];
    const float depth = ((r[6] * x + r[7] * y) + r[8] * z) + c.translation[2];
    if (!(depth >= near_m && depth <= far_m)) continue;  // also drops NaN
    const float cam_x = ((r[0] * x + r[1] * y) + r[2] * z) + c.translation[0];
    const float cam_y = ((r[3] * x + r[4] * y) + r[5] * z) + c.translation[1];
    const float u = c.fx * cam_x / depth + c.cx, v = c.fy * cam_y / depth + c.cy;
    float side = splat.pixels;
    if (splat.metres > 0.0f) {
      side = c.fx * splat.metres / depth;
      if (side < splat.pixels) side = splat.pixels;
      if (side > splat.max_pixels) side = splat.max_pixels;
    }
    if (!(u > -side && v > -side && u < c.width + side && v < c.height + side)) continue;
    int left = first_pixel(u, side), right = last_pixel(u, side), top = first_pixel(v, side), bottom = last_pixel(v, side);
    if (left < 0) left = 0;
    if (top < 0) top = 0;
    if (right >= c.width) right = c.width - 1;
    if (bottom >= c.height) bottom = c.height - 1;
    std::uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    const std::uint64_t key = (std::uint64_t{bits} << 32) | (first_index + static_cast<std::uint32_t>(i));
    for (int row = top; row <= bottom; ++row)
      for (int column = left; column <= right; ++column) keep_nearest(keys[static_cast<std::int64_t>(row) * c.width + column], key);
  }
}

}  // namespace

extern "C" {

// Draws points xyz f32[count, 3] into keys. cam_from_points: f32[12], rows of [R | t]. intrinsics: fx, fy, cx, cy.
// Point i carries the index first_index + i; the caller keeps the sum below 2^32.
MUDG_API void mudg_zbuffer_draw(const float* xyz, std::int64_t count, std::uint32_t first_index, const float* cam_from_points,
                                const float* intrinsics, int width, int height, float splat_pixels, float splat_metres,
                                float splat_max_pixels, float near_m, float far_m, std::uint64_t* keys) {
  Camera camera{};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) camera.rotation[3 * row + column] = cam_from_points[4 * row + column];
    camera.translation[row] = cam_from_points[4 * row + 3];
  }
  camera.fx = intrinsics[0];
  camera.fy = intrinsics[1];
  camera.cx = intrinsics[2];
  camera.cy = intrinsics[3];
  camera.width = width;
  camera.height = height;
  const Splat splat{splat_pixels, splat_metres, splat_max_pixels};
  static_assert(sizeof(std::atomic<std::uint64_t>) == sizeof(std::uint64_t), "pixels are plain 64-bit words");
  auto* pixels = reinterpret_cast<std::atomic<std::uint64_t>*>(keys);
  mudg::parallel_for(count, 16384, [&](std::int64_t begin, std::int64_t end, int) {
    draw(xyz, begin, end, first_index, camera, splat, near_m, far_m, pixels);
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
