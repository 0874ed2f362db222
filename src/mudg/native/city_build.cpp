// Turns the records that Python lays out (one per thing) into shapes with looks.
#include <initializer_list>

#include "city_world.h"

namespace mudg::city {
namespace {

struct Record {
  int kind, public_id;
  float x, y, z, yaw, length, width, height;
  uint32_t seed;
  Vec3 rgb, rgb2;
  float p[12];
  explicit Record(const double* r)
      : kind(static_cast<int>(r[0])), public_id(static_cast<int>(r[27])), x(static_cast<float>(r[1])), y(static_cast<float>(r[2])),
        z(static_cast<float>(r[3])), yaw(static_cast<float>(r[4])), length(static_cast<float>(r[5])),
        width(static_cast<float>(r[6])), height(static_cast<float>(r[7])), seed(static_cast<uint32_t>(r[8])),
        rgb{static_cast<float>(r[9]), static_cast<float>(r[10]), static_cast<float>(r[11])},
        rgb2{static_cast<float>(r[12]), static_cast<float>(r[13]), static_cast<float>(r[14])} {
    for (int i = 0; i < 12; ++i) p[i] = static_cast<float>(r[15 + i]);
  }
};

// Adds shapes given in the frame of one record (x forward, y left, z up, origin on the ground) to the world.
class Sink {
 public:
  Sink(World& world, float x, float y, float z, float yaw)
      : w_(world), origin_{x, y, z}, cs_(std::cos(yaw)), sn_(std::sin(yaw)), yaw_(yaw) {}

  Vec3 place(Vec3 p) const { return origin_ + from_yaw_frame(p, cs_, sn_); }
  Vec3 turn(Vec3 d) const { return from_yaw_frame(d, cs_, sn_); }

  int add(Shape s, const Look& look) {
    s.seed = look.seed;
    w_.shapes.push_back(s);
    w_.looks.push_back(look);
    return static_cast<int>(w_.shapes.size()) - 1;
  }
  int box(Vec3 center, Vec3 half, const Look& look, float yaw = 0) { return oriented(kBox, center, half, look, yaw); }
  int ellipsoid(Vec3 center, Vec3 radii, const Look& look) { return oriented(kEllipsoid, center, radii, look, 0); }
  int leaves(Vec3 center, Vec3 radii, float cell, float density, const Look& look, bool round = true) {
    const int i = oriented(round ? kLeafEllipsoid : kLeafBox, center, radii, look, 0);
    w_.shapes[i].p0 = cell;
    w_.shapes[i].p1 = density;
    return i;
  }
  int cylinder(Vec3 from, Vec3 to, float radius, const Look& look) {
    Shape s;
    s.type = kCylinder;
    s.center = place(from);
    const Vec3 axis = to - from;
    s.p0 = length(axis);
    s.half = turn(normalize(axis));
    s.p1 = radius;
    return add(s, look);
  }
  // Upright card whose normal has the given heading; half_w, half_h in metres.
  int card(Vec3 center, float half_w, float half_h, float heading, CardMask mask, float a, float b, const Look& look) {
    const int i = oriented(kCard, center, {0, half_w, half_h}, look, heading);
    w_.shapes[i].mask = mask;
    w_.shapes[i].p0 = a;
    w_.shapes[i].p1 = b;
    return i;
  }
  struct Side {
    Vec3 normal, through;
  };
  int convex(std::initializer_list<Side> sides, float rounding, const Look& look) {
    Shape s;
    s.type = kConvex;
    s.first = static_cast<int32_t>(w_.pools.planes.size());
    s.count = static_cast<uint16_t>(sides.size());
    s.p0 = rounding;
    for (const Side& side : sides) {
      const Vec3 n = turn(normalize(side.normal));
      w_.pools.planes.push_back({n, dot(n, place(side.through))});
    }
    return add(s, look);
  }
  int facade(Vec3 center, Vec3 half, const FacadeLayout& layout, const Look& look) {
    const int i = oriented(kFacade, center, half, look, 0);
    w_.shapes[i].first = static_cast<int32_t>(w_.pools.facades.size());
    w_.pools.facades.push_back(layout);
    return i;
  }
  void contact(float half_x, float half_y, float reach, float strength, Vec3 at = {}) {
    const Vec3 p = place(at);
    w_.contacts.push_back({p.x, p.y, cs_, sn_, half_x, half_y, reach, strength});
  }

 private:
  int oriented(ShapeType type, Vec3 center, Vec3 half, const Look& look, float yaw) {
    Shape s;
    s.type = type;
    s.center = place(center);
    s.half = half;
    s.cs = std::cos(yaw_ + yaw);
    s.sn = std::sin(yaw_ + yaw);
    return add(s, look);
  }
  World& w_;
  Vec3 origin_;
  float cs_, sn_, yaw_;
};

Look look_of(Class cls, Material material, Vec3 rgb, uint32_t seed = 0, Vec3 rgb2 = {0.5f, 0.5f, 0.5f}) {
  Look l;
  l.cls = cls;
  l.material = material;
  l.rgb = rgb;
  l.rgb2 = rgb2;
  l.seed = seed;
  return l;
}

Look with_numbers(Look look, float p0, float p1, float p2, float p3) {
  look.p0 = p0;
  look.p1 = p1;
  look.p2 = p2;
  look.p3 = p3;
  return look;
}

// Parameters: 0 bay, 1 floor height, 2 ground floor height, 3 window share, 4 sill, 5 window height, 6 recess, 7 shop,
// 8 roof (0 flat, 1 gable), 9 balconies, 10 wall material (0 render, 1 brick). The street front is local -y.
void add_building(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  Draws draw(r.seed);
  const float hx = 0.5f * r.length, hy = 0.5f * r.width, h = r.height;
  FacadeLayout f;
  f.bay_m = r.p[0];
  f.floor_m = r.p[1];
  f.ground_m = r.p[2];
  f.width = r.p[3];
  f.sill_m = r.p[4];
  f.height_m = r.p[5];
  f.recess_m = r.p[6];
  f.shop = r.p[7];
  Look wall = look_of(kBuilding, kMatFacade, r.rgb, r.seed, r.rgb2);
  wall.p0 = r.p[10];
  wall.p1 = f.shop;
  wall.p2 = f.ground_m;
  wall.p3 = f.floor_m;
  s.facade({0, 0, 0.5f * h}, {hx, hy, 0.5f * h}, f, wall);
  s.contact(hx, hy, 1.6f, 0.5f);
  const Look trim = look_of(kBuilding, kMatConcrete, r.rgb2, r.seed + 1);
  if (r.p[8] < 0.5f) {
    const float lip = 0.12f + 0.25f * draw();
    s.box({0, 0, h + 0.1f}, {hx + lip, hy + lip, 0.22f}, trim);
    if (draw() < 0.55f) {  // machine room, chimneys
      s.box({draw(-0.5f, 0.5f) * hx, draw(-0.3f, 0.4f) * hy, h + 1.2f}, {draw(1.0f, 2.2f), draw(0.8f, 1.6f), 1.1f}, trim);
    }
    for (int i = 0; i < 2; ++i)
      s.box({draw(-0.8f, 0.8f) * hx, draw(-0.7f, 0.2f) * hy, h + 0.7f}, {0.35f, 0.3f, 0.6f}, trim);
  } else {
    const float rise = draw(1.6f, 2.6f) * std::min(1.0f, hy / 4.5f), eave = 0.45f;
    const Vec3 tile = draw() < 0.6f ? Vec3{0.23f, 0.085f, 0.05f} : Vec3{0.075f, 0.07f, 0.075f};
    const Look roof = look_of(kBuilding, kMatRoofTiles, tile * draw(0.8f, 1.2f), r.seed + 2);
    const float base = h - 0.06f, ex = hx + eave, ey = hy + eave;
    s.convex({{{0, 0, -1}, {0, 0, base}}, {{0, rise, ey}, {0, ey, base}}, {{0, -rise, ey}, {0, -ey, base}},
              {{1, 0, 0}, {ex, 0, base}}, {{-1, 0, 0}, {-ex, 0, base}}}, 0, roof);
    s.box({draw(-0.6f, 0.6f) * hx, 0.3f * hy, base + rise}, {0.35f, 0.3f, 0.9f}, look_of(kBuilding, kMatBrick, {0.25f, 0.12f, 0.08f}, r.seed));
  }
  if (h > f.ground_m + 1.0f) {  // a string course above the ground floor
    s.box({0, 0, f.ground_m - 0.06f}, {hx + 0.09f, hy + 0.09f, 0.11f}, trim);
  }
  const float bays = std::max(1.0f, std::floor(2 * hx / f.bay_m + 0.5f)), bay = 2 * hx / bays;
  if (r.p[9] > 0.5f) {  // balconies on some bays of the street front
    const int step = 2 + draw.below(2), offset = draw.below(2);
    const Look slab = look_of(kBuilding, kMatConcrete, r.rgb2 * 0.9f, r.seed + 3);
    const Look rail = look_of(kBuilding, kMatMetal, draw() < 0.5f ? Vec3{0.05f, 0.05f, 0.055f} : Vec3{0.45f, 0.45f, 0.45f}, r.seed + 4);
    const float depth = 1.05f;
    for (int floor = 1; f.ground_m + floor * f.floor_m < h - 0.4f && floor < 7; ++floor)
      for (int b = offset; b < static_cast<int>(bays); b += step) {
        const float x = -hx + (b + 0.5f) * bay, z = f.ground_m + (floor - 1) * f.floor_m + 0.1f, half = 0.44f * bay;
        s.box({x, -hy - 0.5f * depth, z}, {half, 0.5f * depth, 0.08f}, slab);
        s.card({x, -hy - depth + 0.03f, z + 0.58f}, half, 0.5f, -0.5f * kPi, kMaskBars, 0.13f, 0.03f, rail);
        s.card({x - half, -hy - 0.5f * depth, z + 0.58f}, 0.5f * depth, 0.5f, kPi, kMaskBars, 0.13f, 0.03f, rail);
        s.card({x + half, -hy - 0.5f * depth, z + 0.58f}, 0.5f * depth, 0.5f, 0, kMaskBars, 0.13f, 0.03f, rail);
      }
  }
  if (f.shop > 0.5f) {
    for (int b = 0; b < static_cast<int>(bays); b += 2) {  // shop signs and awnings over pairs of bays
      const float span = std::min(2.0f, bays - b) * bay, x = -hx + b * bay + 0.5f * span;
      const Vec3 paint{draw(0.03f, 0.6f), draw(0.03f, 0.5f), draw(0.03f, 0.55f)};
      const Look sign = look_of(kBuilding, kMatShopSign, paint, r.seed + 10 + static_cast<uint32_t>(b));
      s.box({x, -hy - 0.07f, f.ground_m - 0.45f}, {0.5f * span - 0.15f, 0.09f, 0.26f}, sign);
      if (draw() < 0.4f) {
        const float out = draw(0.9f, 1.4f), top = f.ground_m - 0.75f, low = top - 0.55f, hw = 0.5f * span - 0.2f;
        Look awning = look_of(kBuilding, kMatAwning, {draw(0.1f, 0.6f), draw(0.05f, 0.4f), draw(0.05f, 0.35f)}, r.seed + 5);
        awning.p0 = x;
        s.convex({{{0, -(top - low), out}, {x, -hy, top}}, {{0, top - low, -out}, {x, -hy, top - 0.06f}}, {{0, -1, 0}, {x, -hy - out, low}},
                  {{0, 1, 0}, {x, -hy + 0.02f, low}}, {{1, 0, 0}, {x + hw, 0, 0}}, {{-1, 0, 0}, {x - hw, 0, 0}}}, 0, awning);
      }
    }
  }
}

// Parameters: 0 crown radius, 1 density, 2 habit (0 round, 1 columnar, 2 conifer), 3 leaf cell, 4 trunk radius.
void add_tree(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  Draws draw(r.seed);
  const float radius = r.p[0], h = r.height, cell = r.p[3];
  const Look bark = look_of(kVegetation, kMatBark, r.rgb2, r.seed);
  const Vec3 lean{draw(-0.05f, 0.05f), draw(-0.05f, 0.05f), 1};
  const auto leaf_look = [&](uint32_t k) {
    Look l = look_of(kVegetation, kMatFoliage, r.rgb * draw(0.85f, 1.15f), r.seed + k);
    return l;
  };
  s.contact(r.p[4], r.p[4], 0.5f, 0.45f);
  if (r.p[2] > 1.5f) {
    s.cylinder({0, 0, 0}, Vec3{0, 0, 0.3f * h}, r.p[4], bark);
    for (int i = 0; i < 5; ++i) {
      const float t = i / 4.0f;
      s.leaves({0, 0, h * (0.22f + 0.7f * t)}, {radius * (1.0f - 0.8f * t), radius * (1.0f - 0.8f * t), 0.16f * h}, cell, r.p[1], leaf_look(i + 1u));
    }
    return;
  }
  const bool tall = r.p[2] > 0.5f;
  const float fork = tall ? 0.25f * h : 0.42f * h;
  s.cylinder({0, 0, -0.1f}, lean * fork, r.p[4], bark);
  const int blobs = tall ? 4 : 4 + draw.below(4);
  for (int i = 0; i < blobs; ++i) {
    const float angle = 2 * kPi * (i + 0.6f * draw()) / blobs;
    const float t = tall ? (i + 0.5f) / blobs : draw();
    const float out = tall ? 0.12f * radius : radius * (0.35f + 0.3f * draw()) * (i == 0 ? 0.1f : 1.0f);
    const float top = h - fork, z = fork + top * (tall ? 0.1f + 0.8f * t : (i == 0 ? 0.62f : 0.25f + 0.4f * t));
    const float rr = tall ? radius * (1.0f - 0.45f * std::fabs(t - 0.4f)) : radius * (i == 0 ? 0.8f : draw(0.5f, 0.72f));
    const Vec3 c{std::cos(angle) * out, std::sin(angle) * out, z};
    s.leaves(c, {rr, rr, tall ? top * 0.22f : rr * draw(0.65f, 0.85f)}, cell, r.p[1], leaf_look(i + 1u));
    if (!tall || i == 0) s.cylinder(lean * (fork * 0.94f), c, r.p[4] * 0.42f, bark);
  }
}

void add_hedge(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const Look leaf = look_of(kVegetation, kMatFoliage, r.rgb, r.seed);
  const Look inner = look_of(kVegetation, kMatPlain, r.rgb * 0.25f, r.seed);
  const float hx = 0.5f * r.length, hy = 0.5f * r.width, hz = 0.5f * r.height;
  s.leaves({0, 0, hz}, {hx, hy, hz}, r.p[3], 0.9f, leaf, false);
  s.box({0, 0, hz - 0.07f}, {hx - 0.14f, hy - 0.14f, std::max(0.05f, hz - 0.13f)}, inner);
  s.contact(hx, hy, 0.5f, 0.5f);
}

void add_bush(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  Draws draw(r.seed);
  for (uint32_t i = 0; i < 3; ++i) {
    const float k = draw(0.6f, 1.0f);
    const Look leaf = look_of(kVegetation, kMatFoliage, r.rgb * draw(0.8f, 1.2f), r.seed + i);
    s.leaves({draw(-0.5f, 0.5f) * r.length, draw(-0.5f, 0.5f) * r.width, 0.4f * r.height * k},
             {0.5f * r.length * k, 0.5f * r.width * k, 0.55f * r.height * k}, r.p[3], 0.85f, leaf);
  }
  s.contact(0.4f * r.length, 0.4f * r.width, 0.4f, 0.5f);
}

// Street lamp; its arm reaches along local +x by parameter 0. Parameter 1: 1 = lantern on top, no arm.
void add_lamp(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const Look metal = look_of(kPole, kMatMetal, r.rgb, r.seed);
  const float radius = 0.5f * r.width;
  s.cylinder({0, 0, 0}, {0, 0, 1.1f}, radius * 1.5f, metal);
  s.cylinder({0, 0, 1.0f}, {0, 0, r.height}, radius, metal);
  Look head = look_of(kPole, kMatLampHead, {0.5f, 0.5f, 0.48f}, r.seed);
  if (r.p[1] > 0.5f) {
    s.cylinder({0, 0, r.height}, {0, 0, r.height + 0.45f}, 0.2f, head);
    s.cylinder({0, 0, r.height + 0.45f}, {0, 0, r.height + 0.55f}, 0.28f, metal);
  } else {
    s.cylinder({0, 0, r.height - 0.1f}, {r.p[0], 0, r.height + 0.35f}, radius * 0.7f, metal);
    s.box({r.p[0] + 0.3f, 0, r.height + 0.36f}, {0.42f, 0.14f, 0.07f}, head);
  }
  s.contact(radius, radius, 0.35f, 0.4f);
}

// Parameters: 0 mask, 1 half size, 2 second plate, 3 motif. The plate faces local +x.
void add_sign(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const Look metal = look_of(kPole, kMatMetal, {0.35f, 0.35f, 0.36f}, r.seed);
  s.cylinder({0, 0, 0}, {0, 0, r.height + r.p[1]}, 0.035f, metal);
  const float half_w = r.width > 0 ? 0.5f * r.width : r.p[1];
  const Look plate = with_numbers(look_of(kTrafficSign, kMatSign, r.rgb, r.seed, r.rgb2), r.p[0], r.p[1], r.p[3], half_w);
  s.card({0.05f, 0, r.height}, half_w, r.p[1], 0, static_cast<CardMask>(static_cast<int>(r.p[0])), 0, 0, plate);
  if (r.p[2] > 0.5f) {
    const Look white = look_of(kTrafficSign, kMatSign, {0.75f, 0.75f, 0.73f}, r.seed + 1, {0.08f, 0.08f, 0.08f});
    const Look extra = with_numbers(white, 0, 0.15f, 9, 0.3f);
    s.card({0.05f, 0, r.height - r.p[1] - 0.2f}, 0.3f, 0.15f, 0, kMaskFull, 0, 0, extra);
  }
  s.contact(0.04f, 0.04f, 0.2f, 0.35f);
}

// Traffic light facing local +x. Parameters: 0 reach of a mast arm along local +y (0: none), 1 lit lamp (0 red, 1 amber, 2 green).
void add_signal(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const Look metal = look_of(kPole, kMatMetal, r.rgb, r.seed);
  const Look body = look_of(kTrafficLight, kMatMetal, {0.025f, 0.027f, 0.025f}, r.seed);
  const auto head = [&](Vec3 at) {
    s.box(at, {0.12f, 0.17f, 0.48f}, body);
    s.box(at + Vec3{-0.02f, 0, 0}, {0.02f, 0.3f, 0.62f}, body);
    for (int i = 0; i < 3; ++i) {
      Look lamp = look_of(kTrafficLight, kMatSignal, i == 0 ? Vec3{0.8f, 0.04f, 0.03f} : (i == 1 ? Vec3{0.8f, 0.45f, 0.03f} : Vec3{0.05f, 0.7f, 0.3f}), r.seed);
      lamp.p0 = static_cast<int>(r.p[1]) == i ? 1.0f : 0.0f;
      const Vec3 c = at + Vec3{0.12f, 0, 0.3f - 0.3f * i};
      s.cylinder(c, c + Vec3{0.015f, 0, 0}, 0.115f, lamp);
      s.box(c + Vec3{0.1f, 0, 0.125f}, {0.1f, 0.12f, 0.01f}, body);
    }
  };
  s.cylinder({0, 0, 0}, {0, 0, r.height}, 0.08f, metal);
  head({0.16f, 0, std::min(r.height - 0.6f, 2.9f)});
  if (r.p[0] > 0.5f) {
    s.cylinder({0, 0, r.height - 0.25f}, {0, r.p[0], r.height + 0.1f}, 0.06f, metal);
    head({0.16f, r.p[0] - 0.2f, r.height - 0.05f});
  }
  s.contact(0.1f, 0.1f, 0.35f, 0.4f);
}

void add_wall(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const Look face = look_of(kWall, r.p[0] > 0.5f ? kMatBrick : kMatConcrete, r.rgb, r.seed);
  const float hx = 0.5f * r.length, hy = 0.5f * r.width, h = r.height;
  s.box({0, 0, 0.5f * h}, {hx, hy, 0.5f * h}, face);
  s.box({0, 0, h + 0.04f}, {hx + 0.03f, hy + 0.05f, 0.05f}, look_of(kWall, kMatConcrete, r.rgb2, r.seed + 1));
  s.contact(hx, hy, 0.7f, 0.5f);
}

// Parameter 0: 0 bars, 1 wire mesh, 2 boards.
void add_fence(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const int style = static_cast<int>(r.p[0]);
  const float hx = 0.5f * r.length, hz = 0.5f * r.height;
  const Look body = look_of(kFence, style == 2 ? kMatWood : kMatMetal, r.rgb, r.seed);
  if (style == 2) {
    s.box({0, 0, hz}, {hx, 0.025f, hz}, body);
  } else if (style == 1) {
    s.card({0, 0, hz}, hx, hz, 0.5f * kPi, kMaskMesh, 0.11f, 0.014f, body);
  } else {
    s.card({0, 0, hz}, hx, hz, 0.5f * kPi, kMaskBars, r.p[1], r.p[2], body);
  }
  const int posts = std::max(2, static_cast<int>(r.length / 2.4f) + 1);
  for (int i = 0; i < posts; ++i) {
    const float x = -hx + r.length * i / (posts - 1);
    s.box({x, 0, hz + 0.03f}, {0.04f, 0.04f, hz + 0.03f}, body);
  }
  s.contact(hx, 0.05f, 0.3f, 0.3f);
}

// One shape of something that Python puts together. Parameters: 0 shape (0 box, 1 cylinder, 2 leaves), 1 class, 2 material,
// 3-5 end of the cylinder relative to its beginning (radius = half the width) or cell and density of the leaves,
// 6-7 half extents, 8 strength of the shade on the ground below.
void add_part(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  Look look = look_of(static_cast<Class>(static_cast<int>(r.p[1])), static_cast<Material>(static_cast<int>(r.p[2])), r.rgb, r.seed, r.rgb2);
  if (look.material == kMatSign) {
    look = with_numbers(look, 0, 0.5f * r.height, 8, 0.5f * r.width);
    s.card({0, 0, 0}, 0.5f * r.width, 0.5f * r.height, 0, kMaskFull, 0, 0, look);
  } else if (r.p[0] > 1.5f) {
    s.leaves({0, 0, 0}, {0.5f * r.length, 0.5f * r.width, 0.5f * r.height}, r.p[3], r.p[4], look);
  } else if (r.p[0] > 0.5f) {
    s.cylinder({0, 0, 0}, {r.p[3], r.p[4], r.p[5]}, 0.5f * r.width, look);
  } else {
    s.box({0, 0, 0}, {0.5f * r.length, 0.5f * r.width, 0.5f * r.height}, look);
  }
  if (r.p[8] > 0) s.contact(r.p[6], r.p[7], 2.5f, r.p[8]);
}

void add_furniture(World& world, const Record& r) {
  Sink s(world, r.x, r.y, r.z, r.yaw);
  const float hx = 0.5f * r.length, hy = 0.5f * r.width, h = r.height;
  switch (r.kind) {
    case kRecPole: {
      const Look wood = look_of(kPole, kMatBark, r.rgb, r.seed);
      s.cylinder({0, 0, 0}, {0, 0, h}, hx, wood);
      if (r.p[0] > 0.5f) s.box({0, 0, h - 0.6f}, {0.06f, 1.1f, 0.06f}, wood);
      break;
    }
    case kRecBollard: s.cylinder({0, 0, 0}, {0, 0, h}, hx, look_of(kPole, kMatMetal, r.rgb, r.seed)); break;
    case kRecBin: {
      const Look body = look_of(kBuilding, kMatMetal, r.rgb, r.seed);
      s.box({0, 0, 0.5f * h}, {hx, hy, 0.5f * h}, body);
      s.box({0, 0, h + 0.03f}, {hx + 0.03f, hy + 0.03f, 0.04f}, look_of(kBuilding, kMatMetal, r.rgb * 0.5f, r.seed));
      break;
    }
    case kRecBench: {
      const Look wood = look_of(kBuilding, kMatWood, {0.22f, 0.12f, 0.06f}, r.seed);
      s.box({0, 0, 0.45f}, {hx, 0.22f, 0.03f}, wood);
      s.box({0, 0.22f, 0.72f}, {hx, 0.025f, 0.16f}, wood);
      for (const float x : {-0.8f, 0.8f}) s.box({x * hx, 0, 0.22f}, {0.04f, 0.2f, 0.22f}, look_of(kBuilding, kMatMetal, {0.05f, 0.05f, 0.05f}));
      break;
    }
    case kRecShelter: {
      const Look frame = look_of(kBuilding, kMatMetal, {0.12f, 0.13f, 0.14f}, r.seed);
      const Look glass = look_of(kBuilding, kMatCarCabin, {0.10f, 0.12f, 0.12f}, r.seed);
      s.box({0, 0, h}, {hx, hy, 0.07f}, frame);
      s.box({0, hy - 0.05f, 0.5f * h + 0.15f}, {hx - 0.1f, 0.015f, 0.5f * h - 0.25f}, glass);
      s.box({hx - 0.1f, 0.1f, 0.5f * h + 0.15f}, {0.06f, hy - 0.2f, 0.5f * h - 0.3f}, look_of(kBuilding, kMatShopSign, r.rgb, r.seed));
      for (const float x : {-1.0f, 1.0f})
        for (const float y : {-1.0f, 1.0f}) s.cylinder({x * (hx - 0.08f), y * (hy - 0.08f), 0}, {x * (hx - 0.08f), y * (hy - 0.08f), h}, 0.04f, frame);
      s.box({-0.2f * hx, hy - 0.35f, 0.46f}, {0.6f * hx, 0.16f, 0.03f}, frame);
      break;
    }
    case kRecPlanter: {
      s.box({0, 0, 0.5f * h}, {hx, hy, 0.5f * h}, look_of(kBuilding, kMatConcrete, r.rgb, r.seed));
      s.leaves({0, 0, h + 0.2f}, {hx * 0.95f, hy * 0.95f, 0.35f}, 0.16f, 0.9f, look_of(kVegetation, kMatFoliage, r.rgb2, r.seed + 1));
      break;
    }
    case kRecHill: s.ellipsoid({0, 0, 0}, {hx, hy, h}, look_of(r.p[0] > 0.5f ? kVegetation : kTerrain, kMatFoliage, r.rgb, r.seed)); return;
    case kRecMotorbike: {
      const Look tyre = look_of(kMotorcycle, kMatTyre, {0.02f, 0.02f, 0.02f}, r.seed);
      const Look body = look_of(kMotorcycle, kMatMetal, r.rgb, r.seed);
      for (const float x : {-0.68f, 0.68f}) s.cylinder({x, -0.06f, 0.3f}, {x, 0.06f, 0.3f}, 0.3f, tyre);
      s.ellipsoid({-0.1f, 0, 0.55f}, {0.62f, 0.17f, 0.22f}, body);
      s.ellipsoid({-0.35f, 0, 0.8f}, {0.42f, 0.15f, 0.1f}, look_of(kMotorcycle, kMatCloth, {0.03f, 0.03f, 0.03f}, r.seed));
      s.cylinder({0.68f, 0, 0.3f}, {0.42f, 0, 1.02f}, 0.05f, body);
      s.cylinder({0.42f, -0.34f, 1.02f}, {0.42f, 0.34f, 1.02f}, 0.025f, tyre);
      s.ellipsoid({0.58f, 0, 0.85f}, {0.14f, 0.16f, 0.2f}, body);
      s.contact(0.9f, 0.2f, 0.35f, 0.6f);
      return;
    }
    case kRecBridge: {  // gantry across the road with direction signs, spanning local y
      const Look metal = look_of(kPole, kMatMetal, {0.35f, 0.36f, 0.37f}, r.seed);
      for (const float y : {-1.0f, 1.0f}) s.box({0, y * hy, 0.5f * h}, {0.14f, 0.14f, 0.5f * h}, metal);
      s.box({0, 0, h}, {0.12f, hy, 0.16f}, metal);
      s.box({0, 0, h + 0.8f}, {0.08f, hy, 0.06f}, metal);
      for (int i = 0; i < 2; ++i) {
        const Look board = look_of(kTrafficSign, kMatSign, r.rgb, r.seed + static_cast<uint32_t>(i), {0.8f, 0.8f, 0.8f});
        const Look plate = with_numbers(board, 0, 0.9f, 8, 1.6f);
        s.card({-0.16f, (i ? -0.4f : 0.4f) * hy, h + 0.5f}, 1.6f, 0.9f, kPi, kMaskFull, 0, 0, plate);
      }
      return;
    }
    default: return;
  }
  s.contact(hx, hy, 0.35f, 0.5f);
}

void add_wheels(Sink& s, Class cls, float half_y, float radius, std::initializer_list<float> axles, uint32_t seed, float rim) {
  Look tyre = look_of(cls, kMatTyre, {0.018f, 0.018f, 0.019f}, seed, Vec3{rim, rim, rim * 1.02f});
  tyre.p0 = radius;
  for (const float x : axles) {
    s.cylinder({x, half_y - 0.22f, radius}, {x, half_y + 0.005f, radius}, radius, tyre);
    s.cylinder({x, -half_y - 0.005f, radius}, {x, -half_y + 0.22f, radius}, radius, tyre);
  }
}

// Parameter 0: 0 saloon, 1 hatchback, 2 tall (SUV), 3 estate.
void add_car(World& world, const Record& r) {
  Sink s(world, 0, 0, 0, 0);
  Draws draw(r.seed);
  const int style = static_cast<int>(r.p[0]);
  const float hl = 0.5f * r.length, hw = 0.5f * r.width, h = r.height;
  const float floor = style == 2 ? 0.30f : 0.20f, belt = h * (style == 2 ? 0.64f : 0.63f);
  const float cowl = hl * (style == 1 ? 0.50f : 0.42f), nose = belt - (style == 2 ? 0.12f : 0.20f);
  const float tail_x = style == 0 ? -0.60f * hl : -0.93f * hl, tail_top = style == 0 ? -0.30f * hl : -0.74f * hl;
  const float wheel = style == 2 ? 0.36f : 0.32f, axle = 0.61f * hl;
  const Look body = with_numbers(look_of(kCar, kMatCarBody, r.rgb, r.seed), hl, hw, axle, wheel);
  const float shoulder = 0.55f * (floor + belt);
  s.convex({{{0, 0, -1}, {0, 0, floor}}, {{0, 0, 1}, {0, 0, belt}},
            {{belt - nose, 0, hl - cowl}, {cowl, 0, belt}}, {{-0.09f, 0, hl + tail_x + 0.05f}, {tail_x, 0, belt}},
            {{1, 0, 0.22f}, {hl, 0, shoulder}}, {{1, 0, -0.45f}, {hl, 0, shoulder - 0.12f}},
            {{-1, 0, 0.12f}, {-hl, 0, shoulder}}, {{-1, 0, -0.4f}, {-hl, 0, shoulder - 0.1f}},
            {{0, 1, 0.20f}, {0, hw, shoulder}}, {{0, 1, -0.16f}, {0, hw, shoulder - 0.1f}},
            {{0, -1, 0.20f}, {0, -hw, shoulder}}, {{0, -1, -0.16f}, {0, -hw, shoulder - 0.1f}},
            {{0.42f, 0.9f, 0}, {hl - 0.30f, hw, 0}}, {{0.42f, -0.9f, 0}, {hl - 0.30f, -hw, 0}},
            {{0.85f, 0.52f, 0}, {hl, 0.62f * hw, 0}}, {{0.85f, -0.52f, 0}, {hl, -0.62f * hw, 0}},
            {{-0.5f, 0.87f, 0}, {-hl + 0.16f, hw, 0}}, {{-0.5f, -0.87f, 0}, {-hl + 0.16f, -hw, 0}}}, 0.11f, body);
  const Look glazed = look_of(kCar, kMatCarCabin, r.rgb, r.seed, {0.02f, 0.023f, 0.025f});
  const Look cabin = with_numbers(glazed, cowl - 0.02f, tail_x, belt, h);
  const float screen_top = cowl - 0.36f * hl, rise = h - belt, tumble = style == 2 ? 0.12f : 0.19f;
  s.convex({{{0, 0, -1}, {0, 0, belt - 0.06f}}, {{0, 0, 1}, {0, 0, h}}, {{rise, 0, cowl - screen_top}, {cowl, 0, belt}},
            {{-rise, 0, tail_top - tail_x}, {tail_x, 0, belt}}, {{0, rise, tumble}, {0, hw - 0.07f, belt}}, {{0, -rise, tumble}, {0, -hw + 0.07f, belt}},
            {{0.10f, 0, 1}, {screen_top - 0.12f, 0, h - 0.01f}}, {{-0.12f, 0, 1}, {tail_top + 0.25f, 0, h - 0.01f}},
            {{0.8f, 0.5f, 0.45f}, {cowl - 0.10f, hw - 0.2f, belt}}, {{0.8f, -0.5f, 0.45f}, {cowl - 0.10f, -hw + 0.2f, belt}}}, 0.07f, cabin);
  add_wheels(s, kCar, hw - 0.02f, wheel, {axle, -axle}, r.seed, draw(0.25f, 0.5f));
  const Look under = look_of(kCar, kMatPlain, {0.012f, 0.012f, 0.012f}, r.seed);
  s.box({0, 0, 0.5f * (floor + 0.16f)}, {hl - 0.25f, hw - 0.22f, 0.5f * (floor - 0.1f)}, under);
  const Look mirror = look_of(kCar, kMatMetal, r.rgb * 0.8f, r.seed);
  for (const float side : {-1.0f, 1.0f}) s.ellipsoid({cowl - 0.32f, side * (hw + 0.02f), belt + 0.06f}, {0.07f, 0.12f, 0.08f}, mirror);
  if (style >= 2 && draw() < 0.5f)
    for (const float side : {-1.0f, 1.0f})
      s.cylinder({-0.6f * hl, side * (hw - 0.26f), h + 0.03f}, {0.05f * hl, side * (hw - 0.26f), h + 0.03f}, 0.02f, under);
}

void add_van(World& world, const Record& r) {
  Sink s(world, 0, 0, 0, 0);
  const float hl = 0.5f * r.length, hw = 0.5f * r.width, h = r.height;
  const Look body = with_numbers(look_of(kCar, kMatBus, r.rgb, r.seed), hl, hw, h, 2);  // van: glass only at the front
  const float screen = 0.52f * h;
  s.convex({{{0, 0, -1}, {0, 0, 0.25f}}, {{0, 0, 1}, {0, 0, h}}, {{1, 0, 0.12f}, {hl, 0, 0.45f * h}}, {{1, 0, -0.3f}, {hl, 0, 0.5f}},
            {{0.5f * h, 0, 0.30f * hl}, {hl - 0.25f, 0, screen}}, {{-1, 0, 0.03f}, {-hl, 0, 0.5f * h}}, {{0, 1, 0.06f}, {0, hw, 0.45f * h}},
            {{0, -1, 0.06f}, {0, -hw, 0.45f * h}}, {{0.6f, 0.8f, 0}, {hl - 0.2f, hw, 0}}, {{0.6f, -0.8f, 0}, {hl - 0.2f, -hw, 0}}}, 0.10f, body);
  add_wheels(s, kCar, hw - 0.02f, 0.34f, {0.62f * hl, -0.58f * hl}, r.seed, 0.3f);
  s.box({0, 0, 0.2f}, {hl - 0.3f, hw - 0.25f, 0.1f}, look_of(kCar, kMatPlain, {0.012f, 0.012f, 0.012f}, r.seed));
  for (const float side : {-1.0f, 1.0f}) s.box({0.66f * hl, side * (hw + 0.1f), screen + 0.2f}, {0.05f, 0.09f, 0.16f}, look_of(kCar, kMatMetal, {0.03f, 0.03f, 0.03f}));
}

// A lorry; with `tank` a round tank instead of the box.
void add_truck(World& world, const Record& r, bool tank) {
  Sink s(world, 0, 0, 0, 0);
  const float hl = 0.5f * r.length, hw = 0.5f * r.width, h = r.height;
  const float cab = 1.9f, cab_h = std::min(h - 0.3f, 2.7f);
  const Look front = with_numbers(look_of(kTruck, kMatBus, r.rgb, r.seed), hl, hw, cab_h, 3);
  s.convex({{{0, 0, -1}, {0, 0, 0.4f}}, {{0, 0, 1}, {0, 0, cab_h}}, {{1, 0, 0.04f}, {hl, 0, 0.9f}}, {{1, 0, 0.22f}, {hl - 0.02f, 0, 1.4f}},
            {{-1, 0, 0}, {hl - cab, 0, 0}}, {{0, 1, 0.02f}, {0, hw - 0.06f, 1}}, {{0, -1, 0.02f}, {0, -hw + 0.06f, 1}},
            {{0.7f, 0.7f, 0}, {hl - 0.15f, hw - 0.06f, 0}}, {{0.7f, -0.7f, 0}, {hl - 0.15f, -hw + 0.06f, 0}}}, 0.10f, front);
  const Look cargo = look_of(kTruck, kMatCargo, r.rgb2, r.seed);
  const float cargo_from = -hl, cargo_to = hl - cab - 0.15f, mid = 0.5f * (cargo_from + cargo_to);
  if (tank) {
    const float radius = std::min(hw - 0.05f, 0.5f * (h - 1.0f));
    Look steel = look_of(kTruck, kMatMetal, r.rgb2, r.seed);
    s.cylinder({cargo_from, 0, 1.0f + radius}, {cargo_to, 0, 1.0f + radius}, radius, steel);
    s.box({mid, 0, 1.0f + 2 * radius}, {0.45f * (cargo_to - cargo_from), 0.25f, 0.06f}, steel);
  } else {
    s.box({mid, 0, 0.5f * (h + 0.95f)}, {0.5f * (cargo_to - cargo_from), hw, 0.5f * (h - 0.95f)}, cargo);
  }
  const Look dark = look_of(kTruck, kMatPlain, {0.02f, 0.02f, 0.022f}, r.seed);
  s.box({0, 0, 0.78f}, {hl - 0.3f, 0.42f, 0.16f}, dark);
  s.box({-hl + 0.08f, 0, 0.62f}, {0.06f, hw - 0.1f, 0.1f}, dark);
  for (const float side : {-1.0f, 1.0f}) {
    s.box({0.1f * hl, side * (hw - 0.2f), 0.62f}, {0.28f * hl, 0.06f, 0.2f}, dark);
    s.box({hl - 0.25f, side * (hw + 0.12f), 1.9f}, {0.06f, 0.1f, 0.24f}, dark);
  }
  add_wheels(s, kTruck, hw - 0.03f, 0.46f, {hl - 1.0f, -hl + 1.2f, -hl + 2.3f}, r.seed, 0.25f);
}

void add_bus(World& world, const Record& r) {
  Sink s(world, 0, 0, 0, 0);
  const float hl = 0.5f * r.length, hw = 0.5f * r.width, h = r.height;
  const Look body = with_numbers(look_of(kBus, kMatBus, r.rgb, r.seed, r.rgb2), hl, hw, h, 1);
  s.convex({{{0, 0, -1}, {0, 0, 0.3f}}, {{0, 0, 1}, {0, 0, h}}, {{1, 0, 0.05f}, {hl, 0, 0.8f}}, {{-1, 0, 0.03f}, {-hl, 0, 0.8f}},
            {{0, 1, 0.02f}, {0, hw, 0.8f}}, {{0, -1, 0.02f}, {0, -hw, 0.8f}}, {{0.7f, 0.7f, 0}, {hl - 0.12f, hw, 0}},
            {{0.7f, -0.7f, 0}, {hl - 0.12f, -hw, 0}}, {{0, 0.5f, 1}, {0, hw - 0.15f, h}}, {{0, -0.5f, 1}, {0, -hw + 0.15f, h}}}, 0.12f, body);
  s.box({-0.1f * hl, 0, h + 0.1f}, {0.35f * hl, 0.7f * hw, 0.12f}, look_of(kBus, kMatMetal, r.rgb * 0.9f, r.seed));
  s.box({0, 0, 0.26f}, {hl - 0.3f, hw - 0.2f, 0.12f}, look_of(kBus, kMatPlain, {0.015f, 0.015f, 0.015f}, r.seed));
  add_wheels(s, kBus, hw - 0.02f, 0.48f, {0.52f * hl, -0.5f * hl}, r.seed, 0.3f);
}

void add_limb(World& world, Posed& posed, int shape, int first, float amplitude, float sign) {
  const Shape& s = world.shapes[shape];
  posed.limbs.push_back({shape - first, s.center, s.half, amplitude, sign, s.p0});
}

// Parameters: 0 walking amplitude (rad), 1 backpack, 2 hair tone.
void add_pedestrian(World& world, const Record& r, Posed& posed) {
  Sink s(world, 0, 0, 0, 0);
  Draws draw(r.seed);
  const float h = r.height, k = h / 1.75f;
  const int first = static_cast<int>(world.shapes.size());
  const Look top = look_of(kPerson, kMatCloth, r.rgb, r.seed), legs = look_of(kPerson, kMatCloth, r.rgb2, r.seed + 1);
  const float tone = draw(0.12f, 0.45f);
  const Look skin = look_of(kPerson, kMatSkin, {tone, tone * 0.7f, tone * 0.52f}, r.seed);
  const Look hair = look_of(kPerson, kMatCloth, Vec3{0.06f, 0.04f, 0.025f} * draw(0.3f, 3.0f), r.seed);
  s.ellipsoid({0, 0, 0.73f * h}, {0.135f * k, 0.21f * k, 0.19f * h}, top);
  s.ellipsoid({0, 0, 0.55f * h}, {0.13f * k, 0.17f * k, 0.09f * h}, legs);
  s.ellipsoid({0.01f, 0, 0.93f * h}, {0.095f * k, 0.08f * k, 0.065f * h}, skin);
  s.ellipsoid({-0.02f, 0, 0.945f * h}, {0.1f * k, 0.09f * k, 0.06f * h}, hair);
  s.cylinder({0, 0, 0.84f * h}, {0, 0, 0.9f * h}, 0.05f * k, skin);
  if (r.p[1] > 0.5f) s.box({-0.18f * k, 0, 0.73f * h}, {0.08f * k, 0.14f * k, 0.13f * h}, look_of(kPerson, kMatCloth, {0.05f, 0.06f, 0.09f}, r.seed));
  for (const float side : {-1.0f, 1.0f}) {
    add_limb(world, posed, s.cylinder({0, 0.09f * side * k, 0.53f * h}, {0, 0.085f * side * k, 0.01f}, 0.075f * k, legs), first, r.p[0], side);
    add_limb(world, posed, s.cylinder({0, 0.215f * side * k, 0.82f * h}, {0.04f, 0.25f * side * k, 0.48f * h}, 0.05f * k, top), first, 0.8f * r.p[0], -side);
  }
}

void add_cyclist(World& world, const Record& r, Posed& posed) {
  Sink s(world, 0, 0, 0, 0);
  Draws draw(r.seed);
  const int first = static_cast<int>(world.shapes.size());
  const Look metal = look_of(kBicycle, kMatMetal, {draw(0.02f, 0.5f), draw(0.02f, 0.3f), draw(0.02f, 0.4f)}, r.seed);
  const Look tyre = look_of(kBicycle, kMatTyre, {0.02f, 0.02f, 0.02f}, r.seed);
  const Look top = look_of(kRider, kMatCloth, r.rgb, r.seed), legs = look_of(kRider, kMatCloth, r.rgb2, r.seed + 1);
  const float tone = draw(0.12f, 0.45f);
  const Look skin = look_of(kRider, kMatSkin, {tone, tone * 0.7f, tone * 0.52f}, r.seed);
  for (const float x : {-0.52f, 0.54f}) {
    s.card({x, 0, 0.345f}, 0.345f, 0.345f, 0.5f * kPi, kMaskWheel, 0.86f, 0, tyre);
    s.card({x, 0.025f, 0.345f}, 0.345f, 0.345f, 0.5f * kPi, kMaskWheel, 0.86f, 0, tyre);
  }
  const Vec3 hub_r{-0.52f, 0, 0.345f}, hub_f{0.54f, 0, 0.345f}, crank{-0.05f, 0, 0.30f}, seat{-0.2f, 0, 0.88f}, head{0.38f, 0, 0.88f};
  s.cylinder(hub_r, crank, 0.018f, metal);
  s.cylinder(hub_r, seat, 0.016f, metal);
  s.cylinder(crank, seat, 0.02f, metal);
  s.cylinder(crank, head, 0.022f, metal);
  s.cylinder(seat + Vec3{0, 0, -0.08f}, head, 0.02f, metal);
  s.cylinder(hub_f, head + Vec3{-0.03f, 0, 0.16f}, 0.02f, metal);
  s.cylinder({0.36f, -0.28f, 1.03f}, {0.36f, 0.28f, 1.03f}, 0.015f, metal);
  const Vec3 hip{-0.2f, 0, 0.98f}, shoulder{0.12f, 0, 1.42f};
  s.cylinder(hip, shoulder, 0.15f, top);
  s.ellipsoid(shoulder, {0.15f, 0.2f, 0.13f}, top);
  s.ellipsoid(hip, {0.17f, 0.17f, 0.14f}, legs);
  s.ellipsoid({0.22f, 0, 1.62f}, {0.1f, 0.085f, 0.12f}, skin);
  s.ellipsoid({0.2f, 0, 1.69f}, {0.13f, 0.095f, 0.085f}, look_of(kRider, kMatMetal, {draw(), draw() * 0.6f, draw() * 0.6f}, r.seed));
  for (const float side : {-1.0f, 1.0f}) {
    s.cylinder({0.12f, 0.19f * side, 1.4f}, {0.36f, 0.22f * side, 1.05f}, 0.05f, top);
    add_limb(world, posed, s.cylinder({-0.16f, 0.1f * side, 0.95f}, {0.05f, 0.1f * side, 0.2f}, 0.075f, legs), first, 0.28f, side);
  }
}

void add_posed(World& world, const Record& r) {
  world.posed.emplace_back();
  Posed& posed = world.posed.back();
  posed.first = static_cast<int>(world.shapes.size());
  posed.kind = r.kind;
  posed.public_id = r.public_id;
  posed.size[0] = r.length;
  posed.size[1] = r.width;
  posed.size[2] = r.height;
  const bool person = r.kind == kRecPedestrian || r.kind == kRecCyclist;
  posed.contact = {0, 0, 1, 0, 0.5f * r.length - (person ? 0.1f : 0.12f), 0.5f * r.width - (person ? 0.1f : 0.1f), person ? 0.35f : 0.55f,
                   person ? 0.55f : 0.9f};
  switch (r.kind) {
    case kRecCar: add_car(world, r); break;
    case kRecVan: add_van(world, r); break;
    case kRecTruck: add_truck(world, r, false); break;
    case kRecTanker: add_truck(world, r, true); break;
    case kRecBus: add_bus(world, r); break;
    case kRecPedestrian: add_pedestrian(world, r, posed); break;
    case kRecCyclist: add_cyclist(world, r, posed); break;
    default: break;
  }
  posed.count = static_cast<int>(world.shapes.size()) - posed.first;
  std::vector<Aabb> boxes;
  boxes.reserve(posed.count);
  for (int i = 0; i < posed.count; ++i) {
    boxes.push_back(bounds_of(world.shapes[posed.first + i], world.pools));
    posed.box.grow(boxes.back());
  }
  for (const Posed::Limb& limb : posed.limbs) {  // room for the swing
    Aabb& box = boxes[limb.shape];
    const float reach = limb.p0 * std::sin(std::fabs(limb.amplitude) + 0.3f) + 0.1f;
    box.lo.x -= reach;
    box.hi.x += reach;
    box.hi.z += 0.1f;
    posed.box.grow(box);
  }
  posed.bvh.build(boxes);
}

void build_contact_cells(World& world) {
  world.contact_x0 = world.road.map_x0;
  world.contact_y0 = world.road.map_y0;
  const float span_x = world.road.nx * world.road.cell, span_y = world.road.ny * world.road.cell;
  world.contact_nx = static_cast<int>(span_x / world.contact_cell) + 1;
  world.contact_ny = static_cast<int>(span_y / world.contact_cell) + 1;
  world.contact_cells.assign(static_cast<size_t>(world.contact_nx) * world.contact_ny, {});
  for (size_t i = 0; i < world.contacts.size(); ++i) {
    const Contact& c = world.contacts[i];
    const float reach = c.reach * 2.0f, ex = std::fabs(c.cs) * c.half_x + std::fabs(c.sn) * c.half_y + reach;
    const float ey = std::fabs(c.sn) * c.half_x + std::fabs(c.cs) * c.half_y + reach;
    const auto cell = [&](float v, float origin, int n) {
      return std::min(n - 1, std::max(0, ifloor((v - origin) / world.contact_cell)));
    };
    for (int iy = cell(c.y - ey, world.contact_y0, world.contact_ny); iy <= cell(c.y + ey, world.contact_y0, world.contact_ny); ++iy)
      for (int ix = cell(c.x - ex, world.contact_x0, world.contact_nx); ix <= cell(c.x + ex, world.contact_x0, world.contact_nx); ++ix)
        world.contact_cells[static_cast<size_t>(iy) * world.contact_nx + ix].push_back(static_cast<int>(i));
  }
}

void build_sun_grid(World& world) {
  SunGrid& grid = world.sun_grid;
  const Vec3 sun = world.light.sun_dir;
  grid.right = normalize(cross(std::fabs(sun.z) < 0.9f ? Vec3{0, 0, 1} : Vec3{1, 0, 0}, sun));
  grid.up = cross(sun, grid.right);
  const float cell = 2.5f;
  // what is looked at: the mapped ground and 60 m above it
  Aabb region;
  const Road& road = world.road;
  region.grow(Vec3{road.map_x0, road.map_y0, 0});
  region.grow(Vec3{road.map_x0 + road.nx * road.cell, road.map_y0 + road.ny * road.cell, 60});
  float lo_x = kInf, hi_x = -kInf, lo_y = kInf, hi_y = -kInf;
  for (int c = 0; c < 8; ++c) {
    const Vec3 p{(c & 1) ? region.hi.x : region.lo.x, (c & 2) ? region.hi.y : region.lo.y, (c & 4) ? region.hi.z : region.lo.z};
    lo_x = std::min(lo_x, dot(p, grid.right));
    hi_x = std::max(hi_x, dot(p, grid.right));
    lo_y = std::min(lo_y, dot(p, grid.up));
    hi_y = std::max(hi_y, dot(p, grid.up));
  }
  grid.x0 = lo_x;
  grid.y0 = lo_y;
  grid.inv_cell = 1 / cell;
  grid.nx = static_cast<int>((hi_x - lo_x) / cell) + 1;
  grid.ny = static_cast<int>((hi_y - lo_y) / cell) + 1;
  std::vector<int> order(world.static_boxes.size());
  for (size_t i = 0; i < order.size(); ++i) order[i] = static_cast<int>(i);
  std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return world.static_boxes[a].half_area() > world.static_boxes[b].half_area(); });
  const float pad = world.light.sun_size * kSunReach * 1.05f + 0.05f;
  grid.first.assign(static_cast<size_t>(grid.nx) * grid.ny + 1, 0);
  for (int pass = 0; pass < 2; ++pass) {  // count, then fill
    for (const int i : order) {
      int ax, bx, ay, by;
      if (!grid.cells_of(world.static_boxes[i], pad, ax, bx, ay, by)) continue;
      for (int iy = ay; iy <= by; ++iy)
        for (int ix = ax; ix <= bx; ++ix) {
          const size_t c = static_cast<size_t>(iy) * grid.nx + ix;
          if (pass == 0) ++grid.first[c + 1];
          else grid.item[grid.first[c]++] = i;
        }
    }
    if (pass == 0) {
      for (size_t c = 1; c < grid.first.size(); ++c) grid.first[c] += grid.first[c - 1];
      grid.item.resize(grid.first.back());
    } else {  // filling moved every start to its end
      for (size_t c = grid.first.size() - 1; c > 0; --c) grid.first[c] = grid.first[c - 1];
      grid.first[0] = 0;
    }
  }
}

}  // namespace

bool SunGrid::cells_of(const Aabb& box, float pad, int& ax, int& bx, int& ay, int& by) const {
  const Vec3 c = (box.lo + box.hi) * 0.5f, e = (box.hi - box.lo) * 0.5f;
  const float cx = dot(c, right), ex = std::fabs(right.x) * e.x + std::fabs(right.y) * e.y + std::fabs(right.z) * e.z + pad;
  const float cy = dot(c, up), ey = std::fabs(up.x) * e.x + std::fabs(up.y) * e.y + std::fabs(up.z) * e.z + pad;
  const auto cell = [&](float v, float origin, int n) { return static_cast<int>(std::min(std::max(std::floor((v - origin) * inv_cell), -1.0f), static_cast<float>(n))); };
  ax = std::max(0, cell(cx - ex, x0, nx));
  bx = std::min(nx - 1, cell(cx + ex, x0, nx));
  ay = std::max(0, cell(cy - ey, y0, ny));
  by = std::min(ny - 1, cell(cy + ey, y0, ny));
  return ax <= bx && ay <= by;
}

void build_world(World& world, const double* records, int64_t count) {
  const auto each = [&](auto&& visit) {
    for (int64_t i = 0; i < count; ++i) visit(Record(records + i * kRecordColumns));
  };
  each([&](const Record& r) {
    switch (r.kind) {
      case kRecBuilding: add_building(world, r); break;
      case kRecTree: add_tree(world, r); break;
      case kRecHedge: add_hedge(world, r); break;
      case kRecBush: add_bush(world, r); break;
      case kRecLamp: add_lamp(world, r); break;
      case kRecSign: add_sign(world, r); break;
      case kRecSignal: add_signal(world, r); break;
      case kRecWall: add_wall(world, r); break;
      case kRecFence: add_fence(world, r); break;
      case kRecPart: add_part(world, r); break;
      default:
        if (r.kind < kRecCar) add_furniture(world, r);
    }
  });
  world.static_count = static_cast<int>(world.shapes.size());
  world.static_boxes.resize(world.static_count);
  for (int i = 0; i < world.static_count; ++i) world.static_boxes[i] = bounds_of(world.shapes[i], world.pools);
  world.static_bvh.build(world.static_boxes);
  build_sun_grid(world);
  build_contact_cells(world);
  each([&](const Record& r) {
    if (r.kind >= kRecCar) add_posed(world, r);
  });
}

}  // namespace mudg::city
