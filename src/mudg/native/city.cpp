// C interface of the procedural city. Built once from records, then only read: any number of frames and sweeps may be
// computed at the same time, and results do not depend on the number of threads.
#include <memory>

#include "api.h"
#include "city_render.h"
#include "parallel.h"

namespace {

using namespace mudg::city;

// Order of the numbers in `road` and `light`; city/world.py holds the same lists.
enum RoadNumber {
  kLeft, kRight, kWalkLeft, kWalkRight, kPavedLeft, kPavedRight, kParkLeft, kParkRight, kHasCross, kCrossS, kCrossX, kCrossY, kCrossYaw,
  kCrossHalf, kCorner, kCrossFrom, kCrossTo, kCrossWalk, kLaneWidth, kSeed, kAsphalt, kWalkColor = kAsphalt + 3, kKerbColor = kWalkColor + 3,
  kTerrainColor = kKerbColor + 3, kSlab = kTerrainColor + 3, kWear, kPatches, kBrick, kMapX0, kMapY0, kMapX1, kMapY1, kRoadNumbers
};
enum LightNumber {
  kSunDir, kSun = kSunDir + 3, kZenith = kSun + 3, kHorizon = kZenith + 3, kAmbient = kHorizon + 3, kCloud = kAmbient + 3,
  kWhite = kCloud + 3, kCloudiness = kWhite + 3, kHaze, kNight, kExposure, kContrast, kSaturation, kNoise, kVignette, kSunSize, kLightNumbers
};

Vec3 vec(const double* p) { return {static_cast<float>(p[0]), static_cast<float>(p[1]), static_cast<float>(p[2])}; }
float num(const double* p, int i) { return static_cast<float>(p[i]); }

// Street coordinates of every map cell: nearest point of the centreline, by Newton steps from the neighbour's solution.
void fill_street_map(Road& road, const double* line, int64_t count, const double* numbers) {
  road.map_x0 = num(numbers, kMapX0);
  road.map_y0 = num(numbers, kMapY0);
  road.cell = 1.0f;
  road.nx = static_cast<int>(num(numbers, kMapX1) - road.map_x0) + 2;
  road.ny = static_cast<int>(num(numbers, kMapY1) - road.map_y0) + 2;
  const size_t cells = static_cast<size_t>(road.nx) * road.ny;
  road.map_s.resize(cells);
  road.map_u.resize(cells);
  const double s0 = line[0], step = line[4] - line[0];  // rows: s, x, y, heading
  for (int iy = 0; iy < road.ny; ++iy) {
    double s = s0 + step * 0.5 * count;
    for (int pass = 0; pass < 2; ++pass)  // the second pass along the row starts from a good guess
      for (int ix = 0; ix < road.nx; ++ix) {
        const double x = road.map_x0 + ix, y = road.map_y0 + iy;
        const int iterations = ix == 0 ? 30 : 4;
        double u = 0;
        for (int it = 0; it < iterations; ++it) {
          double at = (s - s0) / step;
          at = std::min(std::max(at, 0.0), count - 1.001);
          const int64_t i = static_cast<int64_t>(at);
          const double f = at - i;
          const double* a = line + 4 * i;
          const double* b = a + 4;
          const double px = a[1] + f * (b[1] - a[1]), py = a[2] + f * (b[2] - a[2]), h = a[3] + f * (b[3] - a[3]);
          const double c = std::cos(h), n = std::sin(h), dx = x - px, dy = y - py;
          const double along = c * dx + n * dy;
          u = -n * dx + c * dy;
          s = s0 + at * step + std::min(std::max(along, -12.0), 12.0);
          if (std::fabs(along) < 1e-4) break;
        }
        if (pass == 0 && ix != 0) break;
        const size_t k = static_cast<size_t>(iy) * road.nx + ix;
        road.map_s[k] = static_cast<float>(s);
        road.map_u[k] = static_cast<float>(u);
      }
  }
}

struct RoadField {
  RoadNumber number;
  float Road::*field;
};
constexpr RoadField kRoadFields[] = {
    {kLeft, &Road::left}, {kRight, &Road::right}, {kWalkLeft, &Road::sidewalk_left}, {kWalkRight, &Road::sidewalk_right},
    {kParkLeft, &Road::park_left}, {kParkRight, &Road::park_right}, {kCrossS, &Road::cross_s}, {kCrossX, &Road::cross_x},
    {kCrossY, &Road::cross_y}, {kCrossHalf, &Road::cross_half}, {kCorner, &Road::corner}, {kCrossFrom, &Road::cross_from},
    {kCrossTo, &Road::cross_to}, {kCrossWalk, &Road::cross_sidewalk}, {kLaneWidth, &Road::lane_width}, {kSlab, &Road::slab},
    {kWear, &Road::wear}, {kPatches, &Road::patches}, {kBrick, &Road::brick}};

void read_road(Road& road, const double* n) {
  for (const RoadField& f : kRoadFields) road.*f.field = num(n, f.number);
  road.paved_left = n[kPavedLeft] > 0.5;
  road.paved_right = n[kPavedRight] > 0.5;
  road.has_cross = n[kHasCross] > 0.5;
  road.cross_cos = static_cast<float>(std::cos(n[kCrossYaw]));
  road.cross_sin = static_cast<float>(std::sin(n[kCrossYaw]));
  road.seed = static_cast<int>(n[kSeed]);
  road.asphalt = vec(n + kAsphalt);
  road.sidewalk = vec(n + kWalkColor);
  road.kerb = vec(n + kKerbColor);
  road.terrain = vec(n + kTerrainColor);
}

Light light_of(const double* n) {
  return {normalize(vec(n + kSunDir)), vec(n + kSun), vec(n + kZenith), vec(n + kHorizon), vec(n + kAmbient), vec(n + kCloud),
          num(n, kCloudiness), num(n, kHaze), num(n, kNight), num(n, kExposure), num(n, kContrast), num(n, kSaturation),
          num(n, kNoise), num(n, kVignette), vec(n + kWhite), num(n, kSunSize)};
}

// Two independent normal numbers from one hash.
void gauss_pair(uint32_t h, float& a, float& b) {
  const float u1 = std::max(unit(mix_bits(h)), 1e-7f), u2 = unit(mix_bits(h ^ 0x5bd1e995u));
  const float r = std::sqrt(-2 * std::log(u1));
  a = r * std::cos(2 * kPi * u2);
  b = r * std::sin(2 * kPi * u2);
}

}  // namespace

extern "C" {

MUDG_API int mudg_city_number_counts(int which) { return which == 0 ? kRoadNumbers : (which == 1 ? kLightNumbers : kRecordColumns); }

// records [n][28]; centreline [m][4] = s, x, y, heading; marks [k][6] = u, half width, period, dash, kind, yellow;
// crosswalks [c][3] = start, length, on the cross street. Returns null when memory runs out.
MUDG_API void* mudg_city_create(const double* records, int64_t n, const double* centreline, int64_t m, const double* marks, int64_t k,
                                const double* crosswalks, int64_t c, const double* road, const double* light, int seed) {
  try {
    auto world = std::make_unique<World>();
    world->seed = seed;
    read_road(world->road, road);
    world->light = light_of(light);
    fill_street_map(world->road, centreline, m, road);
    for (int64_t i = 0; i < k; ++i) {
      const double* p = marks + 6 * i;
      world->road.marks.push_back({num(p, 0), num(p, 1), num(p, 2), num(p, 3), static_cast<MarkKind>(static_cast<int>(p[4])), p[5] > 0.5});
    }
    for (int64_t i = 0; i < c; ++i) world->road.crosswalks.push_back({num(crosswalks, 3 * i), num(crosswalks, 3 * i + 1), crosswalks[3 * i + 2] > 0.5});
    build_world(*world, records, n);
    return world.release();
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

// rgb f32 [height][width][3]; to be called before anything is rendered. Slots are TextureSlot in city_world.h. 0 = done.
MUDG_API int mudg_city_set_texture(void* handle, int slot, const float* rgb, int width, int height, float metres) {
  if (slot < 0 || slot >= kTexSlots || width < 1 || height < 1 || !(metres > 0)) return 1;
  try {
    fill_texture(static_cast<World*>(handle)->textures[slot], rgb, width, height, metres);
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  }
}

MUDG_API void mudg_city_destroy(void* handle) { delete static_cast<World*>(handle); }

MUDG_API int64_t mudg_city_shape_count(void* handle) { return static_cast<int64_t>(static_cast<World*>(handle)->shapes.size()); }

// camera = fx, fy, cx, cy; world_from_cam row-major 4x4; poses [objects][4], phases [objects].
// samples per pixel = supersample^2, the first through the pixel's centre: it alone gives depth, class and instance.
// rgb f32 [h][w][3] in [0,1] (display values), depth f32 [h][w] metres, +inf in the sky. noise_key 0: no sensor noise.
MUDG_API int mudg_city_render(void* handle, const double* poses, const double* phases, const double* camera, int width, int height,
                              const double* world_from_cam, int supersample, uint32_t noise_key, float* rgb, float* depth, uint8_t* semantics,
                              int32_t* instance) {
  const World& world = *static_cast<World*>(handle);
  try {
    const Moment moment(world, poses, 1, phases);
    const float fx = num(camera, 0), fy = num(camera, 1);
    const double cx = camera[2], cy = camera[3];
    const Vec3 right{num(world_from_cam, 0), num(world_from_cam, 4), num(world_from_cam, 8)};
    const Vec3 down{num(world_from_cam, 1), num(world_from_cam, 5), num(world_from_cam, 9)};
    const Vec3 forward{num(world_from_cam, 2), num(world_from_cam, 6), num(world_from_cam, 10)};
    const Vec3 origin{num(world_from_cam, 3), num(world_from_cam, 7), num(world_from_cam, 11)};
    const int samples = supersample * supersample;
    const float inv_diag2 = 4.0f / (static_cast<float>(width) * width + static_cast<float>(height) * height);
    constexpr int kTile = 8;
    const auto ray_through = [&](double x, double y) {
      return right * (static_cast<float>(x - cx) / fx) + down * (static_cast<float>(y - cy) / fy) + forward;
    };
    const auto shade_pixel = [&](int col, int row, const TileCandidates& tile) {
      const size_t at = static_cast<size_t>(row) * width + col;
      Vec3 sum{0, 0, 0};
      for (int k = 0; k < samples; ++k) {
        float ox = 0, oy = 0;
        if (k > 0) {  // the other samples spiral around the centre
          const float angle = 2.39996323f * k, radius = 0.56f * std::sqrt(static_cast<float>(k) / samples);
          ox = radius * std::cos(angle);
          oy = radius * std::sin(angle);
        }
        const float px = static_cast<float>((col + 0.5 - cx)) / fx + ox / fx, py = static_cast<float>((row + 0.5 - cy)) / fy + oy / fy;
        const Vec3 ray = right * px + down * py + forward;
        const float inv = 1.0f / length(ray);
        const Moment::Sample sample = moment.look(origin, ray * inv, 0, inv / fx, hash_bits(col, row, k), &tile);
        const Vec3& c = sample.radiance;  // very bright samples are compressed before averaging: fewer jagged highlights
        const float peak = std::max(c.x, std::max(c.y, c.z));
        sum += peak > 4 ? c * (4 / peak) : c;
        if (k == 0) {
          depth[at] = sample.cls == kSky ? INFINITY : sample.t * inv;
          semantics[at] = sample.cls;
          instance[at] = sample.instance;
        }
      }
      const float dx = col + 0.5f - 0.5f * width, dy = row + 0.5f - 0.5f * height;
      Vec3 out = tone_map(world.light, sum * (1.0f / samples), (dx * dx + dy * dy) * inv_diag2);
      if (noise_key != 0) {
        float n0, n1, n2, n3;
        gauss_pair(hash_bits(col, row, static_cast<int>(noise_key)), n0, n1);
        gauss_pair(hash_bits(col, row, static_cast<int>(noise_key ^ 0x9e37u)), n2, n3);
        const float sigma = world.light.noise * (0.5f + std::sqrt(std::max(0.0f, out.y)) * 0.8f);
        out += Vec3{0.6f * n3 + 0.8f * n0, 0.6f * n3 + 0.8f * n1, 0.6f * n3 + 0.9f * n2} * sigma;
      }
      rgb[3 * at] = clamp01(out.x);
      rgb[3 * at + 1] = clamp01(out.y);
      rgb[3 * at + 2] = clamp01(out.z);
    };
    const int tile_rows = (height + kTile - 1) / kTile;
    mudg::parallel_for(tile_rows, 1, [&](int64_t begin, int64_t end, int) {
      TileCandidates tile;
      for (int y0 = static_cast<int>(begin) * kTile; y0 < std::min<int>(static_cast<int>(end) * kTile, height); y0 += kTile)
        for (int x0 = 0; x0 < width; x0 += kTile) {
          const int x1 = std::min(x0 + kTile, width), y1 = std::min(y0 + kTile, height);
          const double pad = 0.1;  // samples reach 0.56 pixel from the centres
          const Vec3 corners[4] = {ray_through(x0 - pad, y0 - pad), ray_through(x1 + pad, y0 - pad), ray_through(x1 + pad, y1 + pad),
                                   ray_through(x0 - pad, y1 + pad)};
          moment.collect(origin, 0, corners, tile);
          for (int row = y0; row < y1; ++row)
            for (int col = x0; col < x1; ++col) shade_pixel(col, row, tile);
        }
    });
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  }
}

// One turn of the scanner. elevation [beams] (rad), azimuth [steps] (rad, in the scanner's frame),
// world_from_lidar [steps][12] = pose at the time of each step, fraction [steps] in [0,1] over the knots of `poses`
// [knots][objects][4]. settings = range m, range noise m, drop-out share, glass drop-out share.
// Output per (step, beam): xyz world metres f32, intensity f32 (< 0: no return), class u8, instance i32.
MUDG_API int mudg_city_sweep(void* handle, const double* poses, int knots, const double* phases, const double* elevation, int beams,
                             const double* azimuth, int steps, const double* world_from_lidar, const double* fraction,
                             const double* settings, uint32_t key, float* xyz, float* intensity, uint8_t* semantics, int32_t* instance) {
  const World& world = *static_cast<World*>(handle);
  try {
    const Moment moment(world, poses, knots, phases);
    const float reach = num(settings, 0), noise = num(settings, 1), drop = num(settings, 2), glass_drop = num(settings, 3);
    const auto origin_of = [&](int64_t j) { return Vec3{num(world_from_lidar + 12 * j, 3), num(world_from_lidar + 12 * j, 7), num(world_from_lidar + 12 * j, 11)}; };
    const auto direction_of = [&](int64_t j, double azimuth_rad, double elevation_rad) {
      const double* m = world_from_lidar + 12 * j;
      const double ce = std::cos(elevation_rad), dx = ce * std::cos(azimuth_rad), dy = ce * std::sin(azimuth_rad), dz = std::sin(elevation_rad);
      return normalize(Vec3{static_cast<float>(m[0] * dx + m[1] * dy + m[2] * dz), static_cast<float>(m[4] * dx + m[5] * dy + m[6] * dz),
                            static_cast<float>(m[8] * dx + m[9] * dy + m[10] * dz)});
    };
    const auto fire = [&](int64_t j, int i, const TileCandidates* tile) {
      const size_t at = static_cast<size_t>(j) * beams + i;
      intensity[at] = -1;
      const Vec3 origin = origin_of(j), d = direction_of(j, azimuth[j], elevation[i]);
      const Moment::Sample s = moment.range(origin, d, num(fraction, static_cast<int>(j)), reach, tile);
      if (s.cls == kSky) return;
      const uint32_t h = hash_bits(static_cast<int>(j), i, static_cast<int>(key));
      const float strength = s.reflectance * (0.25f + 0.75f * s.incidence);
      float lost = drop + (s.glass ? glass_drop : 0.0f);
      lost += 0.8f * smoothstep(0.35f, 1.0f, s.t / reach) * clamp01(1 - 3 * strength);
      if (unit(mix_bits(h ^ 0xa511u)) < lost) return;
      float n0, n1;
      gauss_pair(h, n0, n1);
      const Vec3 p = origin + d * (s.t + noise * n0);
      xyz[3 * at] = p.x;
      xyz[3 * at + 1] = p.y;
      xyz[3 * at + 2] = p.z;
      intensity[at] = clamp01(std::sqrt(std::max(0.0f, strength)) * (1 + 0.05f * n1));
      semantics[at] = s.cls;
      instance[at] = s.instance;
    };
    // a few neighbouring columns share their candidates, when they are narrow enough to lie in one flat-sided pyramid
    constexpr int kColumns = 6;
    constexpr double kPad = 3e-3;
    const double lowest = *std::min_element(elevation, elevation + beams) - kPad, highest = *std::max_element(elevation, elevation + beams) + kPad;
    mudg::parallel_for((steps + kColumns - 1) / kColumns, 2, [&](int64_t begin, int64_t end, int) {
      TileCandidates candidates;
      for (int64_t block = begin; block < end; ++block) {
        const int64_t first = block * kColumns, last = std::min<int64_t>(first + kColumns, steps) - 1, middle = (first + last) / 2;
        const double a0 = std::min(azimuth[first], azimuth[last]), a1 = std::max(azimuth[first], azimuth[last]);
        const TileCandidates* tile = nullptr;
        if (a1 - a0 < 0.05 && std::fabs(lowest) < 0.9 && std::fabs(highest) < 0.9) {
          const double b0 = a0 - kPad, b1 = a1 + kPad;
          const Vec3 corners[4] = {direction_of(middle, b0, lowest), direction_of(middle, b1, lowest), direction_of(middle, b1, highest),
                                   direction_of(middle, b0, highest)};
          const float slack = std::max(length(origin_of(first) - origin_of(middle)), length(origin_of(last) - origin_of(middle))) + 1e-3f;
          moment.collect(origin_of(middle), slack, corners, candidates);
          tile = &candidates;
        }
        for (int64_t j = first; j <= last; ++j)
          for (int i = 0; i < beams; ++i) fire(j, i, tile);
      }
    });
    return 0;
  } catch (const std::bad_alloc&) {
    return 1;
  }
}

// Signed distance to the kerb line (negative on the road) and street coordinates at n world points.
MUDG_API void mudg_city_street(void* handle, const double* xy, int64_t n, double* out) {
  const Road& road = static_cast<World*>(handle)->road;
  for (int64_t i = 0; i < n; ++i) {
    float s, u;
    const float x = num(xy, static_cast<int>(2 * i)), y = num(xy, static_cast<int>(2 * i + 1));
    road.main_coordinates(x, y, s, u);
    out[3 * i] = s;
    out[3 * i + 1] = u;
    out[3 * i + 2] = road.kerb_distance_at(x, y);
  }
}

}  // extern "C"
