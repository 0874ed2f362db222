// Road network and ground of the procedural city: where road, kerb, sidewalk and open ground are, and what paint lies on them.
#pragma once
#include <vector>

#include "city_math.h"

namespace mudg::city {

constexpr float kKerbHeight = 0.13f;
constexpr float kKerbWidth = 0.16f;

enum MarkKind : uint8_t { kMarkSolid, kMarkDashed, kMarkDouble, kMarkHatched };
enum GroundPart : uint8_t { kGroundRoad, kGroundKerb, kGroundSidewalk, kGroundTerrain };

struct LaneMark {
  float u, half_width, period_m, dash_m;  // lateral position, left positive
  MarkKind kind;
  bool yellow;
};
struct Crosswalk {
  float s;       // along the street it crosses
  float length;  // extent along that street
  bool on_cross; // false: lies on the main street
};

// Curved main street in (s, u) coordinates: s along, u to the left. One optional straight cross street in (a, b).
struct Road {
  // bilinear map of (s, u) over the world
  float map_x0 = 0, map_y0 = 0, cell = 1;
  int nx = 0, ny = 0;
  std::vector<float> map_s, map_u;
  float left = 5, right = -5;                 // kerb positions
  float sidewalk_left = 3, sidewalk_right = 3;
  bool paved_left = true, paved_right = true; // ground beyond the sidewalk
  float park_left = 0, park_right = 0;        // width of the parking bands inside the kerbs
  bool has_cross = false;
  float cross_s = 0, cross_x = 0, cross_y = 0, cross_cos = 1, cross_sin = 0, cross_half = 4, corner = 4;
  float cross_from = -1e6f, cross_to = 1e6f;  // extent of the cross street along a
  float cross_sidewalk = 2.5f;
  std::vector<LaneMark> marks;
  std::vector<Crosswalk> crosswalks;
  float lane_width = 3.4f;
  int seed = 1;
  // looks
  Vec3 asphalt{0.1f, 0.1f, 0.1f}, sidewalk{0.35f, 0.34f, 0.32f}, kerb{0.4f, 0.4f, 0.38f}, terrain{0.1f, 0.14f, 0.05f};
  float slab = 1.2f, wear = 0.5f, patches = 0.4f, brick = 0;

  // World to street coordinates of the main street.
  void main_coordinates(float x, float y, float& s, float& u) const {
    float gx = (x - map_x0) / cell, gy = (y - map_y0) / cell;
    gx = std::min(std::max(gx, 0.0f), nx - 1.001f);
    gy = std::min(std::max(gy, 0.0f), ny - 1.001f);
    const int ix = static_cast<int>(gx), iy = static_cast<int>(gy);
    const float fx = gx - ix, fy = gy - iy;
    const int k = iy * nx + ix;
    s = mix(mix(map_s[k], map_s[k + 1], fx), mix(map_s[k + nx], map_s[k + nx + 1], fx), fy);
    u = mix(mix(map_u[k], map_u[k + 1], fx), mix(map_u[k + nx], map_u[k + nx + 1], fx), fy);
  }
  void cross_coordinates(float x, float y, float& a, float& b) const {
    const float dx = x - cross_x, dy = y - cross_y;
    a = cross_cos * dx + cross_sin * dy;
    b = -cross_sin * dx + cross_cos * dy;
  }
  // Signed distance to the nearest kerb line, negative on the road (approximate away from it, exact in sign).
  float kerb_distance(float u, float a, float b) const {
    const float main = std::max(u - left, right - u);
    if (!has_cross) return main;
    const float cross = std::max(std::max(std::fabs(b) - cross_half, a - cross_to), cross_from - a);
    if (main < corner && cross < corner && main > 0 && cross > 0) {
      return corner - std::sqrt(square(corner - main) + square(corner - cross));
    }
    return std::min(main, cross);
  }
  float kerb_distance_at(float x, float y) const {
    float s, u, a = 0, b = 0;
    main_coordinates(x, y, s, u);
    if (has_cross) cross_coordinates(x, y, a, b);
    return kerb_distance(u, a, b);
  }
};

struct GroundHit {
  float t = kInf;
  GroundPart part = kGroundTerrain;
  Vec3 normal{0, 0, 1};
};

// First hit of a downward ray with the ground: raised sidewalks, the road plane below, and the kerb between them.
inline GroundHit intersect_ground(const Road& road, Vec3 o, Vec3 d, float t_max) {
  GroundHit hit;
  if (d.z > -1e-6f) return hit;
  const float t_top = (kKerbHeight - o.z) / d.z, t_road = -o.z / d.z;
  const auto distance = [&](float t) { return road.kerb_distance_at(o.x + d.x * t, o.y + d.y * t); };
  if (t_top >= t_max && o.z > kKerbHeight) return hit;
  float t_lo = 0.02f;
  if (o.z > kKerbHeight) {
    const float k = distance(t_top);
    if (k >= 0) {
      hit.t = t_top;
      hit.part = k < kKerbWidth ? kGroundKerb : kGroundSidewalk;
      return hit;
    }
    t_lo = t_top;
  }
  // above the road now: does the path to the road plane run into a kerb?
  const float t_end = t_road;
  float before = t_lo, first_inside = -1;
  constexpr int kSteps = 3;
  for (int i = 1; i <= kSteps; ++i) {
    const float t = t_lo + (t_end - t_lo) * i / kSteps;
    if (distance(t) >= 0) {
      first_inside = t;
      break;
    }
    before = t;
  }
  if (first_inside < 0) {
    hit.t = t_road;
    hit.part = kGroundRoad;
    return hit;
  }
  float lo = before, hi = first_inside;
  for (int i = 0; i < 14; ++i) {
    const float mid = 0.5f * (lo + hi);
    (distance(mid) >= 0 ? hi : lo) = mid;
  }
  hit.t = lo;
  hit.part = kGroundKerb;
  const float x = o.x + d.x * lo, y = o.y + d.y * lo, e = 0.05f;
  const float gx = road.kerb_distance_at(x + e, y) - road.kerb_distance_at(x - e, y);
  const float gy = road.kerb_distance_at(x, y + e) - road.kerb_distance_at(x, y - e);
  hit.normal = normalize(Vec3{-gx, -gy, 0});
  return hit;
}

// Albedo of the ground at a point; footprint_m = size of a pixel on it; gloss gets the smoothness of wet or oily spots.
Vec3 ground_albedo(const Road& road, GroundPart& part, Vec3 p, float footprint_m, float& gloss);

}  // namespace mudg::city
