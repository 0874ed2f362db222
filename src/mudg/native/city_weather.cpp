// Wet ground, snow and street lamps of the city, and the exact planes of a view that weather is computed from.
#include "api.h"
#include "city_render.h"
#include "parallel.h"

namespace mudg::city {
namespace {

// Two octaves of value noise, patches about `size` metres wide.
float patches(Vec3 p, float size, int seed) {
  const float x = p.x / size, y = p.y / size;
  return 0.7f * noise2(x, y, seed) + 0.3f * noise2(2.7f * x, 2.7f * y, seed + 1);
}

}  // namespace

float water_at(const Weather& w, Vec3 p) {
  return smoothstep(w.puddle_level - 0.02f, w.puddle_level + 0.02f, patches(p, 2.5f, w.puddle_seed));
}

float snow_at(const Weather& w, Vec3 p, Vec3 normal, float openness) {
  const float patch = smoothstep(w.snow_level - 0.06f, w.snow_level + 0.06f, patches(p, 1.5f, w.snow_seed));
  return smoothstep(0.3f, 0.8f, normal.z) * smoothstep(0.2f, 0.7f, openness) * patch;
}

Vec3 lamp_color() { return {1.0f, 0.82f, 0.55f}; }
float lamp_cone(float down) { return smoothstep(0.258819f, 0.508819f, down); }  // half angle of 75 degrees

}  // namespace mudg::city

extern "C" {

using namespace mudg::city;

// numbers = wetness, level and seed of the noise of puddles, level and seed of that of snow (level 2: none), lamp power; lamps [n][3],
// world metres. To be called before anything is rendered. 0 = done.
MUDG_API int mudg_city_set_weather(void* handle, const double* numbers, const double* lamps, int64_t n) {
  Weather& w = static_cast<World*>(handle)->weather;
  try {
    w.wet = static_cast<float>(numbers[0]);
    w.puddle_level = static_cast<float>(numbers[1]);
    w.puddle_seed = static_cast<int>(numbers[2]);
    w.snow_level = static_cast<float>(numbers[3]);
    w.snow_seed = static_cast<int>(numbers[4]);
    w.lamp_power = static_cast<float>(numbers[5]);
    w.any = w.wet > 0 || w.snow_level < 1.5f;
    for (int64_t i = 0; i < n; ++i)
      w.lamps.push_back({static_cast<float>(lamps[3 * i]), static_cast<float>(lamps[3 * i + 1]), static_cast<float>(lamps[3 * i + 2])});
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  }
}

// What the rays through the pixel centres meet; arguments as of mudg_city_render. Per pixel ten numbers f32 [h][w][10]: normal, albedo,
// share of open sky, 1 = the sun shines on it, snow cover, standing water; all 0 in the sky.
MUDG_API int mudg_city_planes(void* handle, const double* poses, const double* phases, const double* camera, int width, int height,
                              const double* world_from_cam, float* planes) {
  const World& world = *static_cast<World*>(handle);
  try {
    const Moment moment(world, poses, 1, phases);
    const auto at = [&](int i) { return static_cast<float>(world_from_cam[i]); };
    const Vec3 right{at(0), at(4), at(8)}, down{at(1), at(5), at(9)}, forward{at(2), at(6), at(10)}, origin{at(3), at(7), at(11)};
    mudg::parallel_for(height, 1, [&](int64_t begin, int64_t end, int) {
      for (int row = static_cast<int>(begin); row < static_cast<int>(end); ++row)
        for (int col = 0; col < width; ++col) {
          const float px = static_cast<float>((col + 0.5 - camera[2]) / camera[0]), py = static_cast<float>((row + 0.5 - camera[3]) / camera[1]);
          const Vec3 ray = right * px + down * py + forward;
          const float inv = 1.0f / length(ray);
          const Moment::Sample s = moment.look(origin, ray * inv, 0, inv / static_cast<float>(camera[0]), hash_bits(col, row, 0), nullptr);
          float* out = planes + (static_cast<size_t>(row) * width + col) * 10;
          std::fill(out, out + 10, 0.0f);
          if (s.cls == kSky) continue;
          const float open = moment.openness(s.point, s.normal, 0);
          const float values[10] = {s.normal.x, s.normal.y, s.normal.z, s.albedo.x, s.albedo.y, s.albedo.z, open, s.sunny ? 1.0f : 0.0f, s.snow, s.water};
          std::copy(values, values + 10, out);
        }
    });
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  }
}

}  // extern "C"
