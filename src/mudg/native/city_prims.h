// Primitive shapes of the procedural city and their exact ray intersections.
// Every shape lives in the frame of its object: static objects in the world, vehicles and people in their own frame.
#pragma once
#include <vector>

#include "city_math.h"

namespace mudg::city {

enum ShapeType : uint8_t { kBox, kCylinder, kEllipsoid, kLeafEllipsoid, kLeafBox, kConvex, kFacade, kCard };
enum CardMask : uint8_t {
  kMaskFull, kMaskDisc, kMaskTriangle, kMaskOctagon, kMaskBars, kMaskMesh, kMaskDiamond, kMaskYield, kMaskWheel
};

// Meaning of the fields by type:
//   box, facade   centre, half (x,y,z), yaw (cs,sn); facade: `first` is the index of its window layout
//   cylinder      centre = base point, half = unit axis, p0 = length, p1 = radius
//   ellipsoid     centre, half = radii, yaw;  leaf shapes: p0 = cell size, p1 = density, seed
//   convex        planes [first, first + count)
//   card          centre, half.y = half width, half.z = half height, yaw of its normal; mask, p0, p1 pattern sizes
struct Shape {
  uint8_t type = kBox, mask = 0;
  uint16_t count = 0;
  int32_t first = 0;
  Vec3 center, half;
  float cs = 1, sn = 0, p0 = 0, p1 = 0;
  uint32_t seed = 0;
};

struct Plane {
  Vec3 n;    // outward unit normal
  float k;   // inside: dot(n, p) <= k
};

// Windows of one building: recessed rectangles repeated over the four fronts.
struct FacadeLayout {
  float bay_m = 3, floor_m = 3.1f, ground_m = 3.6f;    // ground_m: height of the ground floor
  float width = 0.5f, sill_m = 0.9f, height_m = 1.5f;  // window width as a fraction of the bay
  float recess_m = 0.18f, base_z = 0;
  float shop = 0;                                      // 1: shop fronts on the ground floor, 0: windows and doors
};

enum FacadePart : uint8_t { kPartWall, kPartGlass, kPartReveal };

struct Hit {
  float t = kInf;
  int prim = -1;          // index into the primitive table; -1 none
  int instance = -1;      // index of the moving/posed object; -1 static world
  Vec3 normal;            // frame of the object
  Vec3 local;             // hit point in the shape's own axes (box, facade, card) or object frame minus centre
  uint8_t face = 0;       // box: 2 * axis + (positive side)
  uint8_t part = 0;
  int16_t bay = 0, floor = 0;
  float wall_u = 0, wall_v = 0;  // facade: metres along the front and above the base; inside a window: fraction of the opening
  float open_w = 0, open_h = 0, open_depth = 0;  // size of the opening and distance still to its plane
};

struct ShapePools {
  std::vector<Plane> planes;
  std::vector<FacadeLayout> facades;
};

inline Vec3 to_yaw_frame(Vec3 p, float cs, float sn) { return {cs * p.x + sn * p.y, -sn * p.x + cs * p.y, p.z}; }
inline Vec3 from_yaw_frame(Vec3 p, float cs, float sn) { return {cs * p.x - sn * p.y, sn * p.x + cs * p.y, p.z}; }

// Entry into an axis-aligned box centred at the origin; false when missed or when the origin is inside.
inline bool enter_box(Vec3 o, Vec3 d, Vec3 half, float t_min, float t_max, float& t, uint8_t& face) {
  float t0 = -kInf, t1 = kInf;
  const float oo[3] = {o.x, o.y, o.z}, dd[3] = {d.x, d.y, d.z}, hh[3] = {half.x, half.y, half.z};
  uint8_t f = 0;
  for (int a = 0; a < 3; ++a) {
    if (std::fabs(dd[a]) < 1e-9f) {
      if (std::fabs(oo[a]) > hh[a]) return false;
      continue;
    }
    const float inv = 1.0f / dd[a];
    const float near_t = (dd[a] > 0 ? -hh[a] - oo[a] : hh[a] - oo[a]) * inv;
    const float far_t = (dd[a] > 0 ? hh[a] - oo[a] : -hh[a] - oo[a]) * inv;
    if (near_t > t0) {
      t0 = near_t;
      f = static_cast<uint8_t>(2 * a + (dd[a] < 0));
    }
    t1 = std::min(t1, far_t);
  }
  if (t0 > t1 || t0 <= t_min || t0 >= t_max) return false;
  t = t0;
  face = f;
  return true;
}

inline Vec3 face_normal(uint8_t face) {
  const float s = (face & 1) ? 1.0f : -1.0f;
  return face < 2 ? Vec3{s, 0, 0} : (face < 4 ? Vec3{0, s, 0} : Vec3{0, 0, s});
}

// One random disc per occupied cell between t0 and t1: foliage that is the same from every view.
inline bool march_leaves(const Shape& s, Vec3 o, Vec3 d, float t0, float t1, bool round, Hit& hit) {
  const float cell = s.p0, inv_cell = 1.0f / cell;
  const float start = t0 + 1e-4f;
  const Vec3 p = o + d * start;
  int ix = ifloor(p.x * inv_cell), iy = ifloor(p.y * inv_cell), iz = ifloor(p.z * inv_cell);
  const int sx = d.x > 0 ? 1 : -1, sy = d.y > 0 ? 1 : -1, sz = d.z > 0 ? 1 : -1;
  const float gx = std::fabs(d.x) > 1e-9f ? 1.0f / std::fabs(d.x) : kInf;
  const float gy = std::fabs(d.y) > 1e-9f ? 1.0f / std::fabs(d.y) : kInf;
  const float gz = std::fabs(d.z) > 1e-9f ? 1.0f / std::fabs(d.z) : kInf;
  const float step_x = cell * gx, step_y = cell * gy, step_z = cell * gz;
  float nx = start + ((d.x > 0 ? (ix + 1) * cell - p.x : p.x - ix * cell)) * gx;
  float ny = start + ((d.y > 0 ? (iy + 1) * cell - p.y : p.y - iy * cell)) * gy;
  float nz = start + ((d.z > 0 ? (iz + 1) * cell - p.z : p.z - iz * cell)) * gz;
  const Vec3 inv_r{1.0f / s.half.x, 1.0f / s.half.y, 1.0f / s.half.z};
  float t_in = t0;
  for (int step = 0; step < 48 && t_in < t1; ++step) {
    const float t_out = std::min(std::min(nx, ny), std::min(nz, t1));
    const uint32_t h = hash_bits(ix, iy, iz, static_cast<int>(s.seed));
    const Vec3 c{(ix + 0.5f) * cell, (iy + 0.5f) * cell, (iz + 0.5f) * cell};
    float density = s.p1;
    if (round) {
      const Vec3 q = c * inv_r;
      density *= 1.0f - 0.55f * smoothstep(0.45f, 1.05f, dot(q, q));
    }
    if (static_cast<float>(h & 255u) < density * 256.0f) {
      const Vec3 jitter{static_cast<float>((h >> 8) & 255u) - 127.5f, static_cast<float>((h >> 16) & 255u) - 127.5f,
                        static_cast<float>(h >> 24) - 127.5f};
      const Vec3 n = normalize(jitter + Vec3{0, 0, 40});
      const Vec3 m = c + Vec3{jitter.y, jitter.z, jitter.x} * (cell * 0.2f / 127.5f);
      const float along = dot(d, n);
      if (std::fabs(along) > 1e-4f) {
        const float t = dot(m - o, n) / along;
        if (t >= t_in && t <= t_out) {
          const Vec3 off = o + d * t - m;
          if (dot(off, off) < square(cell * 0.72f)) {
            hit.t = t;
            hit.normal = along > 0 ? n * -1.0f : n;
            hit.local = o + d * t;
            hit.part = static_cast<uint8_t>(h >> 13);  // leaf colour variation
            return true;
          }
        }
      }
    }
    t_in = t_out;
    if (nx <= ny && nx <= nz) {
      ix += sx;
      nx += step_x;
    } else if (ny <= nz) {
      iy += sy;
      ny += step_y;
    } else {
      iz += sz;
      nz += step_z;
    }
  }
  return false;
}

// True where a card is solid; u, v in [-1,1] over its half sizes, a, b in metres from its centre.
inline bool card_solid(const Shape& s, float a, float b) {
  const float u = a / s.half.y, v = b / s.half.z;
  switch (s.mask) {
    case kMaskDisc: return u * u + v * v < 1;
    case kMaskTriangle: return std::fabs(u) < (1 - v) * 0.5f;
    case kMaskYield: return std::fabs(u) < (1 + v) * 0.5f;
    case kMaskOctagon: return std::fabs(u) + std::fabs(v) < 1.41f;
    case kMaskDiamond: return std::fabs(u) + std::fabs(v) < 1;
    case kMaskBars: {
      if (v > 0.86f || std::fabs(v + 0.8f) < 0.06f) return true;
      return fract(a / s.p0) * s.p0 < s.p1;
    }
    case kMaskMesh: {
      if (std::fabs(v) > 0.96f || fract(a / 2.5f) * 2.5f < 0.06f) return true;
      return fract((a + b) / s.p0) * s.p0 < s.p1 || fract((a - b) / s.p0) * s.p0 < s.p1;
    }
    case kMaskWheel: {
      const float r2 = u * u + v * v;
      if (r2 > 1) return false;
      return r2 > square(s.p0) || r2 < 0.012f;
    }
    default: return true;
  }
}

inline bool intersect_facade(const Shape& s, const FacadeLayout& f, Vec3 lo, Vec3 ld, float t_min, float t_max, Hit& hit) {
  float t;
  uint8_t face;
  if (!enter_box(lo, ld, s.half, t_min, t_max, t, face)) return false;
  const Vec3 p = lo + ld * t;
  hit.face = face;
  hit.part = kPartWall;
  hit.normal = face_normal(face);
  hit.local = p;
  hit.t = t;
  if (face >= 4) return true;
  const bool along_y = face < 2;
  const float half_w = along_y ? s.half.y : s.half.x;
  const float u = (along_y ? p.y : p.x) + half_w, v = p.z + s.half.z - f.base_z;
  const float du = along_y ? ld.y : ld.x, dn = std::fabs(along_y ? ld.x : ld.y);
  hit.wall_u = u;
  hit.wall_v = v;
  const float total_h = 2 * s.half.z;
  const float bays = std::max(1.0f, std::floor(2 * half_w / f.bay_m + 0.5f));
  const float bay = 2 * half_w / bays;
  const int iu = std::min(static_cast<int>(bays) - 1, static_cast<int>(u / bay));
  const bool ground = v < f.ground_m;
  const int iv = ground ? 0 : 1 + static_cast<int>((v - f.ground_m) / f.floor_m);
  hit.bay = static_cast<int16_t>(iu);
  hit.floor = static_cast<int16_t>(iv);
  const float floor_z = ground ? 0 : f.ground_m + (iv - 1) * f.floor_m;
  const float floor_h = ground ? f.ground_m : f.floor_m;
  if (floor_z + floor_h > total_h - 0.15f) return true;
  float x0 = (0.5f - 0.5f * f.width) * bay, x1 = bay - x0;
  float z0 = f.sill_m, z1 = std::min(f.sill_m + f.height_m, floor_h - 0.25f), recess = f.recess_m;
  if (ground && f.shop > 0.5f) {
    x0 = 0.18f;
    x1 = bay - 0.18f;
    z0 = 0.35f;
    z1 = floor_h - 0.85f;
    recess = 0.3f;
  } else if (ground && (hash_bits(iu, face, static_cast<int>(s.seed)) & 3u) == 0) {
    x0 = 0.5f * bay - 0.55f;
    x1 = 0.5f * bay + 0.55f;
    z0 = 0.02f;
    z1 = 2.25f;
    hit.floor = -1;  // a door
  }
  const float wu = u - iu * bay, wv = v - floor_z;
  if (wu <= x0 || wu >= x1 || wv <= z0 || wv >= z1) return true;
  const float dz = ld.z;
  float travel = recess / std::max(dn, 1e-6f);
  hit.part = kPartGlass;
  float side = 0;
  const float reach_u = du > 0 ? (x1 - wu) / du : (du < 0 ? (x0 - wu) / du : kInf);
  const float reach_v = dz > 0 ? (z1 - wv) / dz : (dz < 0 ? (z0 - wv) / dz : kInf);
  if (std::min(reach_u, reach_v) < travel) {
    hit.part = kPartReveal;
    if (reach_u < reach_v) {
      travel = reach_u;
      side = du > 0 ? -1.0f : 1.0f;
      hit.normal = along_y ? Vec3{0, side, 0} : Vec3{side, 0, 0};
    } else {
      travel = reach_v;
      hit.normal = {0, 0, dz > 0 ? -1.0f : 1.0f};
    }
  }
  hit.t = t + travel;
  if (hit.t >= t_max) return false;
  hit.local = lo + ld * hit.t;
  // position inside the opening, as fractions, for frames and curtains
  hit.wall_u = (wu + du * travel - x0) / (x1 - x0);
  hit.wall_v = (wv + dz * travel - z0) / (z1 - z0);
  hit.open_w = x1 - x0;
  hit.open_h = z1 - z0;
  hit.open_depth = dn * travel;
  return true;
}

inline bool intersect_convex(const Shape& s, const Plane* planes, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  float t0 = -kInf, t1 = kInf;
  int face = -1;
  for (int i = 0; i < s.count; ++i) {
    const Plane& q = planes[s.first + i];
    const float dist = q.k - dot(q.n, o), rate = dot(q.n, d);
    if (rate < -1e-9f) {
      const float t = dist / rate;
      if (t > t0) {
        t0 = t;
        face = i;
      }
    } else if (rate > 1e-9f) {
      t1 = std::min(t1, dist / rate);
    } else if (dist < 0) {
      return false;
    }
    if (t0 > t1) return false;
  }
  if (t0 <= t_min || t0 >= t_max || face < 0) return false;
  hit.t = t0;
  hit.face = static_cast<uint8_t>(face);
  hit.local = o + d * t0;
  Vec3 n = planes[s.first + face].n;
  if (s.p0 > 0) {  // rounded edges: lean towards the neighbouring faces close to an edge
    for (int i = 0; i < s.count; ++i) {
      if (i == face) continue;
      const Plane& q = planes[s.first + i];
      const float w = 1.0f - (q.k - dot(q.n, hit.local)) / s.p0;
      if (w > 0) n += q.n * (0.8f * w * w);
    }
    n = normalize(n);
  }
  hit.normal = n;
  return true;
}

inline bool intersect_box(const Shape& s, const ShapePools& pools, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  const Vec3 lo = to_yaw_frame(o - s.center, s.cs, s.sn), ld = to_yaw_frame(d, s.cs, s.sn);
  if (s.type == kFacade) {
    if (!intersect_facade(s, pools.facades[s.first], lo, ld, t_min, t_max, hit)) return false;
  } else {
    float t;
    uint8_t face;
    if (!enter_box(lo, ld, s.half, t_min, t_max, t, face)) return false;
    hit.t = t;
    hit.face = face;
    hit.normal = face_normal(face);
    hit.local = lo + ld * t;
  }
  hit.normal = from_yaw_frame(hit.normal, s.cs, s.sn);
  return true;
}

inline bool intersect_cylinder(const Shape& s, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  // from the point of the ray next to the base: the quadratic stays accurate far away
  const float shift = dot(s.center - o, d);
  const Vec3 r = o + d * shift - s.center, axis = s.half;
  const float da = dot(d, axis), ra = dot(r, axis);
  const float a = 1.0f - da * da, b = dot(r, d) - ra * da, c = dot(r, r) - ra * ra - s.p1 * s.p1;
  if (a > 1e-9f) {
    const float q = b * b - a * c;
    if (q <= 0) return false;
    const float t = (-b - std::sqrt(q)) / a, y = ra + t * da;
    if (y >= 0 && y <= s.p0) {
      if (t + shift <= t_min || t + shift >= t_max) return false;
      hit.t = t + shift;
      hit.local = r + d * t;
      hit.normal = (hit.local - axis * y) * (1.0f / s.p1);
      hit.face = 6;
      hit.wall_u = y;
      return true;
    }
  }
  if (std::fabs(da) < 1e-9f) return false;
  const float t = ((da > 0 ? 0.0f : s.p0) - ra) / da;
  if (t + shift <= t_min || t + shift >= t_max) return false;
  const Vec3 p = r + d * t;
  const float along = dot(p, axis);
  if (dot(p, p) - along * along > s.p1 * s.p1) return false;
  hit.t = t + shift;
  hit.local = p;
  hit.normal = axis * (da > 0 ? -1.0f : 1.0f);
  hit.face = da > 0 ? 4 : 5;
  hit.wall_u = along;
  return true;
}

inline bool intersect_ellipsoid(const Shape& s, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  const float shift = dot(s.center - o, d);
  const Vec3 lo = to_yaw_frame(o + d * shift - s.center, s.cs, s.sn), ld = to_yaw_frame(d, s.cs, s.sn);
  const Vec3 inv{1.0f / s.half.x, 1.0f / s.half.y, 1.0f / s.half.z};
  const Vec3 so = lo * inv, sd = ld * inv;
  const float a = dot(sd, sd), b = dot(so, sd), c = dot(so, so) - 1.0f, q = b * b - a * c;
  if (q <= 0) return false;
  const float root = std::sqrt(q), t0 = (-b - root) / a, t1 = (-b + root) / a;
  if (s.type == kEllipsoid) {
    if (t0 + shift <= t_min || t0 + shift >= t_max) return false;
    hit.t = t0 + shift;
    hit.local = lo + ld * t0;
    hit.normal = from_yaw_frame(normalize(hit.local * inv * inv), s.cs, s.sn);
    return true;
  }
  const float in = std::max(t0, t_min - shift), out = std::min(t1, t_max - shift);
  if (in >= out || !march_leaves(s, lo, ld, in, out, true, hit)) return false;
  hit.t += shift;
  hit.normal = from_yaw_frame(hit.normal, s.cs, s.sn);
  return true;
}

inline bool intersect_leaf_box(const Shape& s, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  const Vec3 lo = to_yaw_frame(o - s.center, s.cs, s.sn), ld = to_yaw_frame(d, s.cs, s.sn);
  float t0 = t_min, t1 = t_max;
  const float oo[3] = {lo.x, lo.y, lo.z}, dd[3] = {ld.x, ld.y, ld.z}, hh[3] = {s.half.x, s.half.y, s.half.z};
  for (int a = 0; a < 3; ++a) {
    if (std::fabs(dd[a]) < 1e-9f) {
      if (std::fabs(oo[a]) > hh[a]) return false;
      continue;
    }
    const float inv = 1.0f / dd[a], ta = (-hh[a] - oo[a]) * inv, tb = (hh[a] - oo[a]) * inv;
    t0 = std::max(t0, std::min(ta, tb));
    t1 = std::min(t1, std::max(ta, tb));
  }
  if (t0 >= t1 || !march_leaves(s, lo, ld, t0, t1, false, hit)) return false;
  hit.normal = from_yaw_frame(hit.normal, s.cs, s.sn);
  return true;
}

inline bool intersect_card(const Shape& s, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  const Vec3 n{s.cs, s.sn, 0};
  const float rate = dot(d, n);
  if (std::fabs(rate) < 1e-9f) return false;
  const Vec3 r = o - s.center;
  const float t = -dot(r, n) / rate;
  if (t <= t_min || t >= t_max) return false;
  const Vec3 p = r + d * t;
  const float a = -s.sn * p.x + s.cs * p.y;
  if (std::fabs(a) > s.half.y || std::fabs(p.z) > s.half.z || !card_solid(s, a, p.z)) return false;
  hit.t = t;
  hit.normal = rate > 0 ? n * -1.0f : n;
  hit.face = rate > 0 ? 0 : 1;  // 1: seen from the front
  hit.local = {0, a, p.z};
  return true;
}

// Nearest entry of the ray into a shape within (t_min, t_max); a shape that holds the origin is not hit from inside.
inline bool intersect(const Shape& s, const ShapePools& pools, Vec3 o, Vec3 d, float t_min, float t_max, Hit& hit) {
  switch (s.type) {
    case kBox:
    case kFacade: return intersect_box(s, pools, o, d, t_min, t_max, hit);
    case kCylinder: return intersect_cylinder(s, o, d, t_min, t_max, hit);
    case kEllipsoid:
    case kLeafEllipsoid: return intersect_ellipsoid(s, o, d, t_min, t_max, hit);
    case kLeafBox: return intersect_leaf_box(s, o, d, t_min, t_max, hit);
    case kConvex: return intersect_convex(s, pools.planes.data(), o, d, t_min, t_max, hit);
    case kCard: return intersect_card(s, o, d, t_min, t_max, hit);
  }
  return false;
}

inline Aabb bounds_of(const Shape& s, const ShapePools& pools) {
  Aabb box;
  switch (s.type) {
    case kCylinder: {
      const Vec3 end = s.center + s.half * s.p0;
      const Vec3 e{s.p1 * std::sqrt(std::max(0.0f, 1 - s.half.x * s.half.x)),
                   s.p1 * std::sqrt(std::max(0.0f, 1 - s.half.y * s.half.y)),
                   s.p1 * std::sqrt(std::max(0.0f, 1 - s.half.z * s.half.z))};
      box.grow(s.center - e);
      box.grow(s.center + e);
      box.grow(end - e);
      box.grow(end + e);
      break;
    }
    case kConvex: {  // vertices: every triple of planes that meets inside
      const Plane* q = pools.planes.data() + s.first;
      for (int i = 0; i < s.count; ++i)
        for (int j = i + 1; j < s.count; ++j) {
          const Vec3 ij = cross(q[i].n, q[j].n);
          for (int k = j + 1; k < s.count; ++k) {
            const float det = dot(ij, q[k].n);
            if (std::fabs(det) < 1e-5f) continue;
            const Vec3 p = (cross(q[j].n, q[k].n) * q[i].k + cross(q[k].n, q[i].n) * q[j].k + ij * q[k].k) * (1 / det);
            bool inside = true;
            for (int m = 0; m < s.count && inside; ++m) inside = dot(q[m].n, p) <= q[m].k + 1e-4f;
            if (inside) box.grow(p);
          }
        }
      break;
    }
    default: {
      Vec3 h = s.half;
      if (s.type == kCard) h.x = 0;
      const float cs = std::fabs(s.cs), sn = std::fabs(s.sn);
      const Vec3 e{cs * h.x + sn * h.y, sn * h.x + cs * h.y, h.z};
      box.grow(s.center - e);
      box.grow(s.center + e);
    }
  }
  const Vec3 pad{1e-3f, 1e-3f, 1e-3f};
  box.lo = box.lo - pad;
  box.hi = box.hi + pad;
  return box;
}

}  // namespace mudg::city
