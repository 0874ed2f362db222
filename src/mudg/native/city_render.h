// Rays through the city: camera frames with all modalities and LiDAR sweeps.
#pragma once
#include "city_world.h"

namespace mudg::city {

struct PosedState {
  float x = 0, y = 0, z = 0, cs = 1, sn = 0;
};

// What the rays of one image tile can hit, nearest first, in groups of four boxes.
struct TileCandidates {
  std::vector<Bvh::Node> groups;   // child = item: >= 0 static shape, < 0 posed object ~child
  std::vector<float> group_bound;  // no ray of the tile enters the group's boxes before this distance
  struct Entry {
    float bound;
    int32_t item;
    Aabb box;
  };
  std::vector<Entry> entries;
};

// The moving part of the city over a short span: poses at evenly spaced knots, limbs at one phase.
class Moment {
 public:
  // poses: [knots][objects][4] = x, y, z, yaw; phases: [objects], radians of the gait; hidden objects have z < -500.
  Moment(const World& world, const double* poses, int knots, const double* phases);

  // Candidates for rays that start within `slack` metres of `origin`, inside the pyramid of the four corner directions (in
  // order around it).
  void collect(Vec3 origin, float slack, const Vec3* corners, TileCandidates& tile) const;

  // Nearest hit of the ray with static and posed shapes in (t_min, t_max); fraction in [0,1] over the span.
  bool closest(const Ray& ray, float t_min, float t_max, float fraction, Hit& hit, const TileCandidates* tile = nullptr) const;
  // Does anything stand between a point and a point of the sun?
  bool occluded(const Ray& ray, float t_min, float t_max, float fraction) const;
  Vec3 turn(int object, float fraction, Vec3 direction) const;
  // Share of ambient light that reaches the ground next to things that stand on it.
  float ground_openness(Vec3 p, float fraction) const;
  // Gloss, light, haze: radiance that leaves the scene against the ray. Fills class and hit distance.
  struct Sample {
    Vec3 radiance;
    float t = kInf;
    uint8_t cls = kSky;
    int32_t instance = 0;
    float reflectance = 0, incidence = 1;  // for the LiDAR
    bool glass = false;
    Vec3 point, normal, albedo;  // of the surface, for the planes of city_weather.cpp
    float snow = 0, water = 0;
    bool sunny = false;
  };
  Sample look(Vec3 origin, Vec3 direction, float fraction, float pixel_angle, uint32_t jitter, const TileCandidates* tile) const;
  // Share of nine directions towards the sky (core/weather/gbuffer.py, open_directions) that nothing stands in.
  float openness(Vec3 point, Vec3 normal, float fraction) const;
  Sample range(Vec3 origin, Vec3 direction, float fraction, float t_max, const TileCandidates* tile) const;

 private:
  const Shape* shapes_of(int object) const {
    const int at = swung_first_[object];
    return at >= 0 ? swung_.data() + at : world_.shapes.data() + world_.posed[object].first;
  }
  PosedState state(int object, float fraction) const {
    if (knots_ == 1) return states_[object];
    return interpolated(object, fraction);
  }
  PosedState interpolated(int object, float fraction) const;
  bool first_hit(Vec3 origin, Vec3 direction, float fraction, float t_max, Hit& hit, GroundHit& ground, const TileCandidates* tile) const;
  template <class Visit>
  bool within(const Ray& ray, int object, float fraction, float t_min, float& best, const Visit& visit) const;
  Vec3 lamp_light(Vec3 point, Vec3 normal, float fraction) const;
  Vec3 wet_mirror(const Sample& ground, Vec3 direction, Vec3 radiance, float wet, float fraction, uint32_t jitter) const;
  bool sun_reaches(const Hit& hit, const Surface& surface, bool on_ground, Vec3 point, Vec3 to_sun, float fraction) const;

  const World& world_;
  int knots_;
  std::vector<PosedState> states_;  // [knots][objects]
  std::vector<float> yaws_;
  std::vector<Shape> swung_;
  std::vector<int> swung_first_;
  std::vector<Aabb> boxes_;
  Bvh top_;
  std::vector<int> sun_head_, sun_next_, sun_object_;  // posed objects by cell of the sun grid
  std::vector<int> contact_head_, contact_next_, contact_object_;
};

}  // namespace mudg::city
