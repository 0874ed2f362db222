#include "city_render.h"

namespace mudg::city {
namespace {
constexpr float kNear = 0.05f;
constexpr float kFar = 900.0f;
constexpr float kLift = 0.012f;  // start of shadow rays above a surface, metres

Class class_of(GroundPart part) { return part == kGroundRoad ? kRoad : (part == kGroundTerrain ? kTerrain : kSidewalk); }

// Snow and water on a surface: its albedo and gloss change. Returns the wetness of road and sidewalk that is not under snow.
template <class Open>
float take_weather(const Weather& weather, Vec3 point, bool on_ground, Surface& surface, Moment::Sample& sample, const Open& open) {
  float wet = 0;
  if (weather.wet > 0 && on_ground && surface.cls != kTerrain && surface.normal.z > 0.8f) {
    wet = weather.wet;
    sample.water = wet * water_at(weather, point);
    surface.albedo *= 1 - wet * 0.6f;
  }
  if (weather.snow_level < 1.5f && surface.normal.z > 0.3f && surface.cls != kPerson && surface.cls != kRider) {
    sample.snow = snow_at(weather, point, surface.normal, open()) * (surface.cls == kVegetation ? 0.6f : 1.0f);
    surface.albedo = mix(surface.albedo, Vec3{0.882f, 0.891f, 0.918f}, sample.snow);
    surface.gloss *= 1 - sample.snow;
    surface.emission *= 1 - sample.snow;
    wet *= 1 - sample.snow;
    sample.water *= 1 - sample.snow;
  }
  return wet;
}
}  // namespace

Moment::Moment(const World& world, const double* poses, int knots, const double* phases) : world_(world), knots_(knots) {
  const int n = static_cast<int>(world.posed.size());
  states_.resize(static_cast<size_t>(n) * knots);
  yaws_.resize(states_.size());
  boxes_.resize(n);
  swung_first_.assign(n, -1);
  contact_head_.assign(static_cast<size_t>(world.contact_nx) * world.contact_ny, -1);
  for (int k = 0; k < knots; ++k)
    for (int i = 0; i < n; ++i) {
      const double* p = poses + (static_cast<size_t>(k) * n + i) * 4;
      PosedState& s = states_[static_cast<size_t>(k) * n + i];
      s.x = static_cast<float>(p[0]);
      s.y = static_cast<float>(p[1]);
      s.z = static_cast<float>(p[2]);
      s.cs = static_cast<float>(std::cos(p[3]));
      s.sn = static_cast<float>(std::sin(p[3]));
      yaws_[static_cast<size_t>(k) * n + i] = static_cast<float>(p[3]);
      const Aabb& b = world.posed[i].box;
      for (int c = 0; c < 8; ++c) {
        const Vec3 corner{(c & 1) ? b.hi.x : b.lo.x, (c & 2) ? b.hi.y : b.lo.y, (c & 4) ? b.hi.z : b.lo.z};
        boxes_[i].grow(Vec3{s.x, s.y, s.z} + from_yaw_frame(corner, s.cs, s.sn));
      }
    }
  if (knots > 1) {  // between knots a turning corner can leave the boxes of the knots by a little
    for (Aabb& b : boxes_) {
      b.lo = b.lo - Vec3{0.05f, 0.05f, 0.01f};
      b.hi = b.hi + Vec3{0.05f, 0.05f, 0.01f};
    }
  }
  for (int i = 0; i < n; ++i) {
    const Posed& posed = world.posed[i];
    if (posed.limbs.empty()) continue;
    swung_first_[i] = static_cast<int>(swung_.size());
    swung_.insert(swung_.end(), world.shapes.begin() + posed.first, world.shapes.begin() + posed.first + posed.count);
    for (const Posed::Limb& limb : posed.limbs) {
      const float angle = limb.amplitude * limb.sign * static_cast<float>(std::sin(phases[i]));
      const float c = std::cos(angle), s = std::sin(angle);
      swung_[swung_first_[i] + limb.shape].half = {c * limb.axis.x - s * limb.axis.z, limb.axis.y, s * limb.axis.x + c * limb.axis.z};
    }
  }
  top_.build(boxes_);
  const SunGrid& grid = world.sun_grid;
  sun_head_.assign(static_cast<size_t>(grid.nx) * grid.ny, -1);
  const float sun_pad = world.light.sun_size * kSunReach * 1.05f + 0.05f;
  for (int i = 0; i < n; ++i) {
    int ax, bx, ay, by;
    if (boxes_[i].lo.z < -100 || !grid.cells_of(boxes_[i], sun_pad, ax, bx, ay, by)) continue;
    for (int iy = ay; iy <= by; ++iy)
      for (int ix = ax; ix <= bx; ++ix) {
        int& head = sun_head_[static_cast<size_t>(iy) * grid.nx + ix];
        sun_next_.push_back(head);
        sun_object_.push_back(i);
        head = static_cast<int>(sun_next_.size()) - 1;
      }
  }
  const auto cell = [&](float v, float origin, int count) { return std::min(count - 1, std::max(0, ifloor((v - origin) / world.contact_cell))); };
  for (int i = 0; i < n; ++i) {
    const float reach = 2 * world.posed[i].contact.reach;
    const Aabb& b = boxes_[i];
    if (b.lo.z < -100 || world.contact_nx == 0) continue;
    for (int iy = cell(b.lo.y - reach, world.contact_y0, world.contact_ny); iy <= cell(b.hi.y + reach, world.contact_y0, world.contact_ny); ++iy)
      for (int ix = cell(b.lo.x - reach, world.contact_x0, world.contact_nx); ix <= cell(b.hi.x + reach, world.contact_x0, world.contact_nx); ++ix) {
        int& head = contact_head_[static_cast<size_t>(iy) * world.contact_nx + ix];
        contact_next_.push_back(head);
        contact_object_.push_back(i);
        head = static_cast<int>(contact_next_.size()) - 1;
      }
  }
}

PosedState Moment::interpolated(int object, float fraction) const {
  const int n = static_cast<int>(world_.posed.size());
  const float at = clamp01(fraction) * (knots_ - 1);
  const int k = std::min(knots_ - 2, static_cast<int>(at));
  const float u = at - k;
  const size_t i0 = static_cast<size_t>(k) * n + object, i1 = i0 + n;
  const PosedState &a = states_[i0], &b = states_[i1];
  if (a.x == b.x && a.y == b.y && yaws_[i0] == yaws_[i1]) return a;
  float turn = yaws_[i1] - yaws_[i0];
  turn -= 2 * kPi * std::floor(turn / (2 * kPi) + 0.5f);
  const float yaw = yaws_[i0] + u * turn;
  return {mix(a.x, b.x, u), mix(a.y, b.y, u), mix(a.z, b.z, u), std::cos(yaw), std::sin(yaw)};
}

Vec3 Moment::turn(int object, float fraction, Vec3 direction) const {
  const PosedState s = state(object, fraction);
  return from_yaw_frame(direction, s.cs, s.sn);
}

void Moment::collect(Vec3 origin, float slack, const Vec3* corners, TileCandidates& tile) const {
  Vec3 normals[4];
  float offsets[4];
  const Vec3 middle = corners[0] + corners[1] + corners[2] + corners[3];
  for (int i = 0; i < 4; ++i) {
    normals[i] = normalize(cross(corners[i], corners[(i + 1) & 3]));
    if (dot(normals[i], middle) > 0) normals[i] = normals[i] * -1.0f;
    offsets[i] = dot(normals[i], origin) + 2e-3f + slack;
  }
  tile.entries.clear();
  const auto bound = [&](const Aabb& b) {
    const Vec3 d{std::max(std::max(b.lo.x - origin.x, origin.x - b.hi.x), 0.0f), std::max(std::max(b.lo.y - origin.y, origin.y - b.hi.y), 0.0f),
                 std::max(std::max(b.lo.z - origin.z, origin.z - b.hi.z), 0.0f)};
    return length(d) * 0.9999f - slack;
  };
  world_.static_bvh.collect(normals, offsets, 4, [&](int item, const Aabb& box) { tile.entries.push_back({bound(box), item, box}); });
  top_.collect(normals, offsets, 4, [&](int object, const Aabb& box) { tile.entries.push_back({bound(box), ~object, box}); });
  std::sort(tile.entries.begin(), tile.entries.end(),
            [](const TileCandidates::Entry& a, const TileCandidates::Entry& b) { return a.bound < b.bound || (a.bound == b.bound && a.item < b.item); });
  const size_t groups = (tile.entries.size() + 3) / 4;
  tile.groups.resize(groups);
  tile.group_bound.resize(groups);
  for (size_t g = 0; g < groups; ++g) {
    tile.group_bound[g] = tile.entries[4 * g].bound;
    for (size_t k = 0; k < 4; ++k) {
      const bool used = 4 * g + k < tile.entries.size();
      const Aabb box = used ? tile.entries[4 * g + k].box : Aabb{};
      const float lo[3] = {box.lo.x, box.lo.y, box.lo.z}, hi[3] = {box.hi.x, box.hi.y, box.hi.z};
      for (int a = 0; a < 3; ++a) {
        tile.groups[g].lo[a][k] = lo[a];
        tile.groups[g].hi[a][k] = hi[a];
      }
      tile.groups[g].child[k] = used ? tile.entries[4 * g + k].item : 0;
    }
  }
}

// Walks through the shapes of a posed object that the ray may hit, in its own frame.
template <class Visit>
bool Moment::within(const Ray& ray, int object, float fraction, float t_min, float& best, const Visit& visit) const {
  const PosedState s = state(object, fraction);
  const Ray local(to_yaw_frame(ray.o - Vec3{s.x, s.y, s.z}, s.cs, s.sn), to_yaw_frame(ray.d, s.cs, s.sn));
  const Shape* shapes = shapes_of(object);
  return world_.posed[object].bvh.traverse(local, t_min, best, [&](int item, float& near_t) { return visit(shapes, local, item, near_t); });
}

bool Moment::closest(const Ray& ray, float t_min, float t_max, float fraction, Hit& hit, const TileCandidates* tile) const {
  bool found = false;
  float limit = t_max;
  Hit trial;
  const auto try_static = [&](int item, float& best) {
    if (intersect(world_.shapes[item], world_.pools, ray.o, ray.d, t_min, best, trial)) {
      hit = trial;
      hit.prim = item;
      hit.instance = -1;
      best = trial.t;
      found = true;
    }
    return false;
  };
  const auto try_posed = [&](int object, float& best) {
    return within(ray, object, fraction, t_min, best, [&](const Shape* shapes, const Ray& local, int item, float& near_t) {
      if (intersect(shapes[item], world_.pools, local.o, local.d, t_min, near_t, trial)) {
        hit = trial;
        hit.prim = world_.posed[object].first + item;
        hit.instance = object;
        near_t = trial.t;
        found = true;
      }
      return false;
    });
  };
  if (tile == nullptr) {
    world_.static_bvh.traverse(ray, t_min, limit, try_static);
    top_.traverse(ray, t_min, limit, try_posed);
    return found;
  }
  const bool neg[3] = {ray.inv.x < 0, ray.inv.y < 0, ray.inv.z < 0};
  for (size_t g = 0; g < tile->groups.size() && tile->group_bound[g] < limit; ++g) {
    alignas(16) float entry[4];
    const int hits = Bvh::slabs(tile->groups[g], ray, neg, t_min, limit, entry);
    for (int k = 0; k < 4; ++k) {
      if (!(hits & (1 << k)) || entry[k] >= limit) continue;
      const int32_t item = tile->groups[g].child[k];
      if (item >= 0) try_static(item, limit);
      else try_posed(~item, limit);
    }
  }
  return found;
}

bool Moment::occluded(const Ray& ray, float t_min, float t_max, float fraction) const {
  Hit trial;
  const auto by_static = [&](int item, float& best) {
    return intersect(world_.shapes[item], world_.pools, ray.o, ray.d, t_min, best, trial);
  };
  const auto by_posed = [&](int object, float& best) {
    return within(ray, object, fraction, t_min, best, [&](const Shape* shapes, const Ray& local, int item, float& near_t) {
      return intersect(shapes[item], world_.pools, local.o, local.d, t_min, near_t, trial);
    });
  };
  float limit = t_max;
  const SunGrid& grid = world_.sun_grid;
  const int cell = grid.cell_of(ray.o);
  if (cell < 0)  // far outside the mapped part
    return world_.static_bvh.traverse(ray, t_min, limit, by_static) || top_.traverse(ray, t_min, limit, by_posed);
  const auto enters = [&](const Aabb& b) {
    const float ax = (b.lo.x - ray.o.x) * ray.inv.x, bx = (b.hi.x - ray.o.x) * ray.inv.x;
    const float ay = (b.lo.y - ray.o.y) * ray.inv.y, by = (b.hi.y - ray.o.y) * ray.inv.y;
    const float az = (b.lo.z - ray.o.z) * ray.inv.z, bz = (b.hi.z - ray.o.z) * ray.inv.z;
    const float near_t = std::max(std::max(std::min(ax, bx), std::min(ay, by)), std::max(std::min(az, bz), t_min));
    const float far_t = std::min(std::min(std::max(ax, bx), std::max(ay, by)), std::min(std::max(az, bz), t_max));
    return near_t <= far_t;
  };
  for (int e = grid.first[cell]; e < grid.first[cell + 1]; ++e)
    if (enters(world_.static_boxes[grid.item[e]]) && by_static(grid.item[e], limit)) return true;
  for (int e = sun_head_[cell]; e >= 0; e = sun_next_[e])
    if (enters(boxes_[sun_object_[e]]) && by_posed(sun_object_[e], limit)) return true;
  return false;
}

float Moment::ground_openness(Vec3 p, float fraction) const {
  if (world_.contact_nx == 0) return 1;
  const int ix = ifloor((p.x - world_.contact_x0) / world_.contact_cell), iy = ifloor((p.y - world_.contact_y0) / world_.contact_cell);
  if (ix < 0 || iy < 0 || ix >= world_.contact_nx || iy >= world_.contact_ny) return 1;
  float open = 1;
  const auto add = [&](const Contact& c, float cx, float cy, float cs, float sn) {
    const float rx = p.x - cx, ry = p.y - cy;
    const float qx = std::fabs(cs * rx + sn * ry) - c.half_x, qy = std::fabs(-sn * rx + cs * ry) - c.half_y;
    const float dx = std::max(qx, 0.0f), dy = std::max(qy, 0.0f), d2 = dx * dx + dy * dy;
    if (d2 > 4 * c.reach * c.reach) return;
    const float near = 1 - std::sqrt(d2) / (2 * c.reach);
    open *= 1 - c.strength * near * near;
  };
  const size_t cell = static_cast<size_t>(iy) * world_.contact_nx + ix;
  for (const int i : world_.contact_cells[cell]) {
    const Contact& c = world_.contacts[i];
    add(c, c.x, c.y, c.cs, c.sn);
  }
  for (int e = contact_head_[cell]; e >= 0; e = contact_next_[e]) {
    const int object = contact_object_[e];
    const PosedState s = state(object, fraction);
    add(world_.posed[object].contact, s.x, s.y, s.cs, s.sn);
  }
  return open;
}

bool Moment::first_hit(Vec3 origin, Vec3 direction, float fraction, float t_max, Hit& hit, GroundHit& ground, const TileCandidates* tile) const {
  ground = intersect_ground(world_.road, origin, direction, t_max);
  const float limit = std::min(t_max, ground.t);
  return closest(Ray(origin, direction), kNear, limit, fraction, hit, tile);
}

bool Moment::sun_reaches(const Hit& hit, const Surface& surface, bool on_ground, Vec3 point, Vec3 to_sun, float fraction) const {
  if (!on_ground && hit.instance < 0 && hit.part != kPartWall && world_.shapes[hit.prim].type == kFacade) {
    // inside a window opening: the light has to come through it, then past everything else
    const Shape& shape = world_.shapes[hit.prim];
    const Vec3 sun = to_yaw_frame(to_sun, shape.cs, shape.sn);
    const bool along_y = hit.face < 2;
    const float sign = (hit.face & 1) ? 1.0f : -1.0f, outward = sign * (along_y ? sun.x : sun.y);
    if (outward <= 1e-3f) return false;
    const float t = hit.open_depth / outward;
    const float x = hit.wall_u * hit.open_w + t * (along_y ? sun.y : sun.x), z = hit.wall_v * hit.open_h + t * sun.z;
    if (x < 0 || x > hit.open_w || z < 0 || z > hit.open_h) return false;
  }
  const Vec3 start = point + (on_ground ? Vec3{0, 0, 1} : surface.normal) * kLift;
  return !occluded(Ray(start, to_sun), 0.02f, kSunReach, fraction);
}

Moment::Sample Moment::look(Vec3 origin, Vec3 direction, float fraction, float pixel_angle, uint32_t jitter, const TileCandidates* tile) const {
  const Light& light = world_.light;
  Sample sample;
  Hit hit;
  GroundHit ground;
  const bool on_shape = first_hit(origin, direction, fraction, kFar, hit, ground, tile);
  if (!on_shape && ground.t >= kFar) {
    sample.radiance = sky_radiance(world_, direction, true);
    return sample;
  }
  Surface surface;
  Vec3 point;
  if (on_shape) {
    sample.t = hit.t;
    point = origin + direction * hit.t;
    surface = shade_surface(world_, hit, point, hit.instance >= 0 ? to_yaw_frame(direction, state(hit.instance, fraction).cs, state(hit.instance, fraction).sn) : direction,
                            hit.t * pixel_angle);
    if (hit.instance >= 0) {
      surface.normal = turn(hit.instance, fraction, surface.normal);
      sample.instance = world_.posed[hit.instance].public_id;
    }
    surface.occlusion *= 0.62f + 0.38f * smoothstep(-0.1f, 0.9f, point.z);
  } else {
    sample.t = ground.t;
    point = origin + direction * ground.t;
    GroundPart part = ground.part;
    const float footprint = ground.t * pixel_angle / std::sqrt(std::max(0.02f, -direction.z));
    surface.albedo = ground_albedo(world_.road, part, point, footprint, surface.gloss);
    const TextureSlot slot = part == kGroundRoad ? kTexRoad : (part == kGroundTerrain ? kTexTerrain : kTexWalk);
    if (!world_.textures[slot].empty()) surface.albedo = surface.albedo * textured(world_, slot, point, {0, 0, 1}, footprint);
    surface.normal = ground.normal;
    surface.cls = class_of(part);
    surface.occlusion = ground_openness(point, fraction);
  }
  sample.cls = surface.cls;
  float wet = 0;
  if (world_.weather.any) wet = take_weather(world_.weather, point, !on_shape, surface, sample, [&] { return openness(point, surface.normal, fraction); });
  sample.point = point;
  sample.normal = surface.normal;
  sample.albedo = surface.albedo;
  // sun
  Vec3 lit{0, 0, 0};
  const float facing = dot(surface.normal, light.sun_dir);
  const float direct = surface.thin > 0 ? mix(std::max(facing, 0.0f), std::fabs(facing), surface.thin) * (facing > 0 ? 1.0f : 0.75f) : facing;
  Vec3 mirror = direction - surface.normal * (2 * dot(direction, surface.normal));
  bool sunny = false;
  if (light.sun.y > 0.02f && direct > 0) {
    const float a = unit(mix_bits(jitter)) * 2 * kPi, r = light.sun_size * std::sqrt(unit(mix_bits(jitter + 77u)));
    const Vec3 side = normalize(cross(light.sun_dir, Vec3{0.3f, -0.2f, 0.93f})), other = cross(light.sun_dir, side);
    const Vec3 to_sun = normalize(light.sun_dir + side * (r * std::cos(a)) + other * (r * std::sin(a)));
    sunny = sun_reaches(hit, surface, !on_shape, point, to_sun, fraction);
    if (sunny) lit = light.sun * direct;
  }
  sample.sunny = sunny;
  if (world_.weather.lamp_power > 0) lit += lamp_light(point, surface.normal, fraction);
  const float up = 0.5f + 0.5f * surface.normal.z;
  const Vec3 bounce = (light.ambient * 0.30f + light.sun * (0.22f * std::max(0.0f, light.sun_dir.z))) * Vec3{0.36f, 0.34f, 0.31f};
  const Vec3 ambient = mix(bounce, light.ambient, up) * surface.occlusion;
  Vec3 radiance = surface.albedo * (lit + ambient) + surface.emission;
  if (surface.gloss > 0.01f) {
    const float k = std::min(surface.gloss, 0.9f);
    radiance = radiance * (1 - 0.6f * k) + mirrored_sky(world_, mirror) * k;
    if (sunny) {
      const float s = std::max(0.0f, dot(mirror, light.sun_dir));
      radiance += light.sun * (k * 2.5f * std::pow(s, 180.0f) + 0.12f * k * std::pow(s, 14.0f));
    }
  }
  if (wet > 0) radiance = wet_mirror(sample, direction, radiance, wet, fraction, jitter);
  const float haze = 1 - std::exp(-sample.t / light.haze_m);
  const Vec3 air = mix(light.horizon, light.horizon * 0.75f + light.ambient * 0.15f, 0.5f);
  sample.radiance = mix(radiance, air, haze);
  return sample;
}

float Moment::openness(Vec3 point, Vec3 normal, float fraction) const {
  const Vec3 start = point + normal * kLift;
  Hit hit;
  int open = 0;
  for (int i = 0; i < 9; ++i) {
    const float a = (i - 1) * (kPi / 4);
    const Vec3 d = i == 0 ? Vec3{0, 0, 1} : Vec3{0.5f * std::cos(a), 0.5f * std::sin(a), 0.8660254f};
    open += !closest(Ray(start, d), 0.02f, 46.0f, fraction, hit);
  }
  return open / 9.0f;
}

Vec3 Moment::lamp_light(Vec3 point, Vec3 normal, float fraction) const {
  float total = 0;
  for (const Vec3& lamp : world_.weather.lamps) {
    const Vec3 to = lamp - point;
    const float d = std::max(length(to), 0.5f);
    if (d > 45) continue;
    const Vec3 l = to * (1 / d);
    const float power = std::max(0.0f, dot(normal, l)) * lamp_cone(l.z);
    Hit hit;
    if (power <= 0 || closest(Ray(point + normal * kLift, l), 0.02f, d - 0.9f, fraction, hit)) continue;
    total += power / (d * d);
  }
  return lamp_color() * (total * world_.weather.lamp_power);
}

// Fresnel mirror of water: sharp in puddles, weak and rough (four tilted normals) on the film between them.
Vec3 Moment::wet_mirror(const Sample& ground, Vec3 direction, Vec3 radiance, float wet, float fraction, uint32_t jitter) const {
  const float share = 0.02f + 0.98f * std::pow(1 - clamp01(-direction.z), 5.0f);
  const float pool = ground.water * share, film = (wet - ground.water) * 0.25f * share;
  const Vec3 start = ground.point + Vec3{0, 0, kLift};
  const auto mirrored = [&](Vec3 n) {
    Vec3 d = direction - n * (2 * dot(direction, n));
    d.z = std::max(d.z, 1e-3f);
    return look(start, normalize(d), fraction, 1e-3f, jitter + 5u, nullptr).radiance;
  };
  radiance = radiance * (1 - pool - film);
  if (pool > 1e-3f) radiance += mirrored({0, 0, 1}) * pool;
  if (film > 1e-3f)
    for (uint32_t k = 0; k < 4; ++k) {
      const float r = 0.01f * std::sqrt(-2 * std::log(std::max(1e-6f, unit(mix_bits(jitter + 31u * k + 7u))))), a = (unit(mix_bits(jitter ^ (k + 977u))) + k) * (kPi / 2);
      radiance += mirrored(normalize(Vec3{r * std::cos(a), r * std::sin(a), 1})) * (0.25f * film);
    }
  return radiance;
}

Moment::Sample Moment::range(Vec3 origin, Vec3 direction, float fraction, float t_max, const TileCandidates* tile) const {
  Sample sample;
  Hit hit;
  GroundHit ground;
  const bool on_shape = first_hit(origin, direction, fraction, t_max, hit, ground, tile);
  if (!on_shape && ground.t >= t_max) return sample;
  Surface surface;
  if (on_shape) {
    sample.t = hit.t;
    const Vec3 point = origin + direction * hit.t;
    const bool moving = hit.instance >= 0;
    const PosedState s = moving ? state(hit.instance, fraction) : PosedState{};
    const Vec3 local = moving ? to_yaw_frame(direction, s.cs, s.sn) : direction;
    surface = shade_surface(world_, hit, point, local, 0.02f);
    if (moving) sample.instance = world_.posed[hit.instance].public_id;
    sample.incidence = std::fabs(dot(local, hit.normal));
    sample.glass = surface.gloss > 0.1f && surface.albedo.x < 0.1f;
    const uint8_t material = world_.looks[hit.prim].material;
    sample.reflectance = material == kMatSign && hit.face == 1 ? 1.6f : dot(surface.albedo, Vec3{0.5f, 0.35f, 0.15f});
  } else {
    sample.t = ground.t;
    GroundPart part = ground.part;
    float gloss = 0;
    surface.albedo = ground_albedo(world_.road, part, origin + direction * ground.t, 0.03f, gloss);
    surface.cls = class_of(part);
    sample.incidence = std::fabs(dot(direction, ground.normal));
    sample.reflectance = dot(surface.albedo, Vec3{0.5f, 0.35f, 0.15f}) * 1.2f;
  }
  sample.cls = surface.cls;
  return sample;
}

}  // namespace mudg::city
