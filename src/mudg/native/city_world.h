// The city as the ray caster sees it: shapes with looks, posed objects, road and light.
#pragma once
#include <vector>

#include "city_bvh.h"
#include "city_ground.h"
#include "city_prims.h"

namespace mudg::city {

// What a surface looks like; evaluated by shade_surface in city_shade.cpp.
enum Material : uint8_t {
  kMatPlain, kMatFacade, kMatFoliage, kMatBark, kMatMetal, kMatCarBody, kMatCarCabin, kMatTyre, kMatBus, kMatCargo, kMatBrick,
  kMatWood, kMatSign, kMatSignal, kMatLampHead, kMatRoofTiles, kMatCloth, kMatSkin, kMatShopSign, kMatConcrete, kMatAwning
};

enum Class : uint8_t {
  kRoad, kSidewalk, kBuilding, kWall, kFence, kPole, kTrafficLight, kTrafficSign, kVegetation, kTerrain, kSky, kPerson, kRider,
  kCar, kTruck, kBus, kTrain, kMotorcycle, kBicycle
};

struct Look {
  uint8_t cls = kBuilding, material = kMatPlain;
  Vec3 rgb{0.5f, 0.5f, 0.5f}, rgb2{0.5f, 0.5f, 0.5f};
  float p0 = 0, p1 = 0, p2 = 0, p3 = 0;
  uint32_t seed = 0;
};

// A soft dark rim around the foot of something that stands on the ground.
struct Contact {
  float x, y, cs, sn, half_x, half_y, reach, strength;
};

// One vehicle or person: shapes [first, first + count) in its own frame, whose origin lies on the ground below its centre.
struct Posed {
  int first = 0, count = 0, kind = 0, public_id = 0;
  float radius = 0, height = 0;
  Bvh bvh;
  Aabb box;
  Contact contact{};
  float size[3] = {};
  // limbs that swing: shape indices with pivot, amplitude and phase sign
  struct Limb {
    int shape;
    Vec3 pivot, axis;
    float amplitude, sign, p0;
  };
  std::vector<Limb> limbs;
};

struct Light {
  Vec3 sun_dir{0.4f, 0.3f, 0.8f}, sun{2.5f, 2.4f, 2.2f};
  Vec3 zenith{0.25f, 0.42f, 0.8f}, horizon{0.75f, 0.82f, 0.9f}, ambient{0.8f, 0.85f, 0.95f}, cloud{0.95f, 0.95f, 0.95f};
  float cloudiness = 0.4f, haze_m = 600, night = 0, exposure = 1, contrast = 1, saturation = 1, noise = 0.006f, vignette = 0.2f;
  Vec3 white{1, 1, 1};
  float sun_size = 0.012f;
};

// Which shapes can stand between a point and the sun: lists over a grid in the plane across the light. A ray towards the sun
// stays in its cell, so no hierarchy has to be searched. Lists are padded for the size of the sun.
struct SunGrid {
  Vec3 right, up;
  float x0 = 0, y0 = 0, inv_cell = 1;
  int nx = 0, ny = 0;
  std::vector<int> first, item;  // items of cell c: item[first[c]] .. item[first[c + 1] - 1], largest shapes first
  int cell_of(Vec3 p) const {
    const int ix = ifloor((dot(p, right) - x0) * inv_cell), iy = ifloor((dot(p, up) - y0) * inv_cell);
    return ix < 0 || iy < 0 || ix >= nx || iy >= ny ? -1 : iy * nx + ix;
  }
  // Cells that a box padded by `pad` metres covers; false when it lies outside.
  bool cells_of(const Aabb& box, float pad, int& ax, int& bx, int& ay, int& by) const;
};
constexpr float kSunReach = 160.0f;  // longest shadow ray, metres

// A photographic surface: albedo relative to its mean, repeated every `metres`, with halved copies for what is far away; or the sky.
enum TextureSlot { kTexRoad, kTexWalk, kTexTerrain, kTexPlaster, kTexBrick, kTexConcrete, kTexBark, kTexRoof, kTexCargo, kTexSky, kTexSlots };
struct Texture {
  struct Level {
    int width = 0, height = 0;
    std::vector<Vec3> texels;
  };
  std::vector<Level> levels;
  float metres = 1;
  bool empty() const { return levels.empty(); }
  Vec3 at(float u, float v, float footprint_m) const;  // u, v in metres
  Vec3 toward(Vec3 direction) const;                   // of a panorama; v = 0 at the zenith, 1 at the horizon
};
void fill_texture(Texture& texture, const float* rgb, int width, int height, float metres);

// Wet ground, snow and street lamps; the same rules as core/weather/light.py. A world without them is never asked.
struct Weather {
  bool any = false;
  float wet = 0;                                // 0..1
  float puddle_level = 2, snow_level = 2;       // levels that noise has to exceed; 2 = nowhere
  int puddle_seed = 0, snow_seed = 0;
  float lamp_power = 0;                         // irradiance over pi at 1 m below a lamp
  std::vector<Vec3> lamps;
};
float water_at(const Weather& weather, Vec3 p);
float snow_at(const Weather& weather, Vec3 p, Vec3 normal, float openness);
Vec3 lamp_color();
float lamp_cone(float down);                    // by the cosine of the angle from straight down

struct World {
  ShapePools pools;
  std::vector<Shape> shapes;
  std::vector<Look> looks;
  Bvh static_bvh;
  std::vector<Aabb> static_boxes;
  SunGrid sun_grid;
  int static_count = 0;
  std::vector<Posed> posed;
  std::vector<Contact> contacts;
  // static contacts by ground cell
  float contact_x0 = 0, contact_y0 = 0, contact_cell = 4;
  int contact_nx = 0, contact_ny = 0;
  std::vector<std::vector<int>> contact_cells;
  Road road;
  Light light;
  Texture textures[kTexSlots];
  Weather weather;
  int seed = 0;
};
Vec3 textured(const World& world, TextureSlot slot, Vec3 point, Vec3 normal, float footprint_m);

// Row layout of the records handed over by Python (city/layout.py keeps the same list).
enum RecordKind {
  kRecBuilding = 1, kRecTree, kRecHedge, kRecLamp, kRecSign, kRecSignal, kRecWall, kRecFence, kRecPole, kRecBin, kRecBench,
  kRecShelter, kRecHill, kRecBush, kRecBridge, kRecBollard, kRecMotorbike, kRecPlanter, kRecPart,
  kRecCar = 50, kRecVan, kRecTruck, kRecBus, kRecPedestrian, kRecCyclist, kRecTanker
};
constexpr int kRecordColumns = 28;
// 0 kind, 1-3 position (m), 4 yaw, 5 length, 6 width, 7 height, 8 seed, 9-11 rgb, 12-14 rgb2, 15-26 parameters, 27 public id

void build_world(World& world, const double* records, int64_t count);

// --- shading ---
struct Surface {
  Vec3 albedo, normal, emission;
  float gloss = 0;        // share of mirrored sky
  float occlusion = 1;    // of the ambient light
  float thin = 0;         // light that shines through leaves
  uint8_t cls = 0;
};
Surface shade_surface(const World& world, const Hit& hit, Vec3 point, Vec3 direction, float footprint_m);
Vec3 sky_radiance(const World& world, Vec3 direction, bool with_sun);
Vec3 mirrored_sky(const World& world, Vec3 direction);
Vec3 tone_map(const Light& light, Vec3 radiance, float vignette_r2);

}  // namespace mudg::city
