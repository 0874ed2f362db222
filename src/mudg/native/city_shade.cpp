// Looks of surfaces, sky and the camera's response.
#include "city_world.h"

namespace mudg::city {
namespace {

Vec3 grey(float v) { return {v, v, v}; }

void shade_brick(const Look& look, float u, float v, float fp, Surface& s) {
  const float row = std::floor(v / 0.075f), shift = u / 0.24f + 0.5f * fract(row * 0.5f) * 2;
  const float detail = clamp01(1.4f - fp * 9.0f);
  const int seed = static_cast<int>(look.seed);
  float tone = 1 + detail * 0.45f * (hash01(ifloor(shift), static_cast<int>(row), seed) - 0.5f);
  tone += 0.5f * fbm_filtered(u, v, 0.5f, fp, seed + 1);
  s.albedo = look.rgb * tone;
  const float joint = std::min(fract(shift) * 0.24f, fract(v / 0.075f) * 0.075f);
  if (joint < 0.012f) s.albedo = mix(s.albedo, grey(0.30f), 0.55f * detail);
}

void shade_window(const World& world, const Look& look, const Hit& hit, Vec3 d, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  const int key = hit.face * 131 + hit.bay, floor = hit.floor;
  const float w = hit.open_w, h = hit.open_h, x = hit.wall_u * w, z = hit.wall_v * h;
  const bool shop = floor == 0 && look.p1 > 0.5f, door = floor < 0;
  const float border = shop ? 0.05f : 0.065f;
  const float edge = std::min(std::min(x, w - x), std::min(z, h - z));
  const float style = hash01(seed, 3, 9);
  const Vec3 frame = style < 0.55f ? grey(0.62f) : (style < 0.8f ? Vec3{0.06f, 0.06f, 0.065f} : look.rgb2 * 0.8f);
  bool is_frame = edge < border;
  if (shop) {
    is_frame = is_frame || std::fabs(fract(x / 1.6f) * 1.6f) < 0.045f || std::fabs(z - 0.78f * h) < 0.03f;
  } else if (door) {
    if (!(z > 0.55f * h && edge > 0.2f)) {
      s.albedo = Vec3{0.05f + 0.3f * hash01(seed, key, 1), 0.05f + 0.18f * hash01(seed, key, 2), 0.05f + 0.15f * hash01(seed, key, 3)};
      if (edge < 0.05f) s.albedo *= 0.6f;
      return;
    }
  } else if (w > 0.95f) {
    is_frame = is_frame || std::fabs(x - 0.5f * w) < 0.035f;
    if (style > 0.4f && h > 1.3f) is_frame = is_frame || std::fabs(z - 0.68f * h) < 0.03f;
  }
  if (is_frame) {
    s.albedo = frame;
    return;
  }
  const float pick = hash01(key, floor, seed + 5), curtain = hash01(key, floor, seed + 6);
  Vec3 inside = grey(0.018f + 0.05f * pick * pick);
  const float lit_share = shop ? 0.85f : 0.45f * world.light.night;
  const float lit = hash01(key, floor, seed + 7) < lit_share ? (shop ? 0.18f + 0.8f * world.light.night : world.light.night) : 0.0f;
  if (shop) {  // shelves and displays behind the pane
    const float item = noise2(x * 2.3f + key, z * 2.9f, seed + 8), item2 = hash01(ifloor(x * 3), ifloor(z * 2.2f), seed + key);
    const float warm = 0.13f * item * (0.4f + 0.6f * item2), tint = 0.05f * item * hash01(ifloor(x * 3), ifloor(z * 2.2f), seed + key + 1);
    inside = Vec3{0.03f + warm + tint, 0.028f + 0.85f * warm, 0.026f + 0.7f * warm + 0.05f * item - tint};
  } else if (curtain < 0.45f) {
    const float drawn = 0.15f + 0.35f * hash01(key, floor, seed + 9);
    const bool cloth = curtain < 0.14f ? z > h * (1 - drawn * 1.8f) : std::min(x, w - x) < w * drawn * 0.6f;
    if (cloth) inside = grey(0.34f + 0.22f * pick) * (0.85f + 0.15f * std::sin(x * 42.0f));
  }
  s.albedo = inside;
  s.emission = Vec3{1.0f, 0.72f, 0.40f} * (lit * (0.25f + inside.x * 2.2f) * (0.6f + 0.7f * pick));
  const float cos_view = std::fabs(dot(d, s.normal));
  s.gloss = 0.10f + 0.75f * std::pow(1 - cos_view, 4.0f);
  if (!shop) s.gloss += 0.08f;
}

void shade_facade(const World& world, const Look& look, const Hit& hit, Vec3 d, float fp, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  if (hit.part == kPartGlass) {
    shade_window(world, look, hit, d, s);
    s.occlusion *= 0.75f;
    return;
  }
  if (hit.part == kPartReveal) {
    s.albedo = look.rgb2 * 0.8f;
    s.occlusion *= 0.6f;
    return;
  }
  if (hit.face >= 4) {
    s.albedo = grey(0.16f);
    return;
  }
  const float u = hit.wall_u, v = hit.wall_v;
  if (look.p0 > 0.5f) {
    shade_brick(look, u, v, fp, s);
  } else {
    const float tone = 1 + 0.35f * fbm_filtered(u, v, 0.35f, fp, seed) + 0.18f * fbm_filtered(u, v, 5.0f, fp, seed + 3);
    s.albedo = look.rgb * tone;
  }
  if (look.p1 > 0.5f && v < look.p2 - 0.05f) s.albedo = mix(s.albedo, look.rgb2 * 0.5f, 0.8f);
  // rain streaks below the sills and dirt above the pavement
  const float streak = noise2(u * 2.2f, v * 0.12f, seed + 7);
  s.albedo *= 1 - 0.22f * smoothstep(0.55f, 0.9f, streak) - 0.25f * smoothstep(0.9f, 0.0f, v);
  if (look.p2 > 0 && hit.floor > 0) {
    const float in_floor = fract((v - look.p2) / look.p3) * look.p3;
    if (in_floor < 0.07f + 0.3f * fp && hash01(seed, 1, 4) < 0.5f) s.albedo *= 0.88f;
  }
}

void shade_car_body(const World& world, const Look& look, const Hit& hit, Vec3 d, Surface& s) {
  const float hl = look.p0, hw = look.p1, axle = look.p2, wheel = look.p3;
  const Vec3 p = hit.local;
  s.albedo = look.rgb;
  s.gloss = 0.09f + 0.45f * std::pow(1 - std::fabs(dot(d, s.normal)), 4.0f);
  const float ax = std::fabs(std::fabs(p.x) - axle), az = p.z - wheel;
  const float arch = std::sqrt(ax * ax + az * az);
  const bool side = std::fabs(p.y) > hw - 0.16f && std::fabs(p.x) < hl - 0.12f;
  if (side) {
    if (arch < wheel + 0.055f) {
      s.albedo = grey(0.012f);
      s.gloss = 0;
      s.occlusion *= 0.4f;
      return;
    }
    if (p.z < 0.30f) s.albedo = grey(0.03f);
    for (const float seam : {0.30f, -0.08f, -0.48f})
      if (std::fabs(p.x - seam * hl) < 0.009f && p.z > 0.36f) s.albedo *= 0.3f;
    for (const float grip : {0.02f, -0.40f})
      if (std::fabs(p.x - grip * hl) < 0.09f && std::fabs(p.z - 0.80f) < 0.018f) s.albedo *= 0.5f;
    if (std::fabs(p.z - 0.46f) < 0.02f) s.albedo *= 0.55f;
  }
  const bool front = p.x > hl - 0.34f, rear = p.x < -hl + 0.24f;
  if (front && p.z < 0.86f) {
    const float ay = std::fabs(p.y);
    if (p.z < 0.30f) {
      s.albedo = grey(0.02f);
    } else if (ay > 0.52f * hw && ay < 0.97f * hw && p.z > 0.56f && p.z < 0.72f) {
      s.albedo = grey(0.7f);
      s.gloss = 0.3f;
      s.emission = Vec3{1.0f, 0.93f, 0.75f} * (world.light.night > 0.05f ? 2.2f : 0.12f);
    } else if (ay < 0.46f * hw && p.z > 0.50f && p.z < 0.68f) {
      s.albedo = grey(fract(p.z * 28.0f) < 0.5f ? 0.015f : 0.06f);
    } else if (ay < 0.26f && p.z > 0.34f && p.z < 0.45f) {
      s.albedo = grey(0.68f);
    } else if (ay < 0.7f * hw && p.z > 0.30f && p.z < 0.47f) {
      s.albedo = grey(0.02f);
    }
  } else if (rear) {
    const float ay = std::fabs(p.y);
    if (p.z < 0.32f) {
      s.albedo = grey(0.025f);
    } else if (ay > 0.58f * hw && p.z > 0.62f && p.z < 0.80f) {
      s.albedo = Vec3{0.30f, 0.010f, 0.010f};
      s.gloss = 0.06f;
      s.emission = Vec3{0.9f, 0.03f, 0.02f} * (world.light.night > 0.05f ? 0.9f : 0.08f);
    } else if (ay < 0.27f && p.z > 0.52f && p.z < 0.64f) {
      s.albedo = grey(0.66f);
    } else if (std::fabs(p.z - 0.50f) < 0.012f) {
      s.albedo *= 0.4f;
    }
  }
}

void shade_glass(Vec3 tint, Vec3 d, Surface& s) {
  s.albedo = tint;
  s.gloss = 0.12f + 0.7f * std::pow(1 - std::fabs(dot(d, s.normal)), 3.0f);
}

void shade_car_cabin(const Look& look, const Hit& hit, Vec3 d, Surface& s) {
  const Vec3 p = hit.local;
  const float cowl = look.p0, tail = look.p1, belt = look.p2, top = look.p3;
  s.albedo = look.rgb;
  s.gloss = 0.09f + 0.4f * std::pow(1 - std::fabs(dot(d, s.normal)), 4.0f);
  if (top <= 0) {
    shade_glass(look.rgb, d, s);
    return;
  }
  const float up = (p.z - belt) / (top - belt);
  if (up < 0.06f || up > 0.90f) return;
  const int face = hit.face;  // 2 windscreen, 3 rear window, 4 and 5 sides (order of the planes)
  if (face == 4 || face == 5) {
    const float front = cowl - 0.40f * (1.0f - 0.0f) - 0.38f * up * (cowl - tail) * 0.42f, rear = tail + 0.22f + 0.3f * up;
    const float mid = 0.46f * (cowl + tail);
    if (p.x < front && p.x > rear && std::fabs(p.x - mid) > 0.045f && up > 0.10f && up < 0.86f) shade_glass(look.rgb2, d, s);
    return;
  }
  if (face == 2 || face == 3 || face >= 8) {
    if (up > 0.07f && up < 0.90f) shade_glass(look.rgb2, d, s);
  }
}

// Buses, vans and lorry cabs: p0 half length, p1 half width, p2 height, p3 1 bus, 2 van, 3 cab.
void shade_big_vehicle(const World& world, const Look& look, const Hit& hit, Vec3 normal, Vec3 d, Surface& s) {
  const Vec3 p = hit.local;
  const float hl = look.p0, hw = look.p1, h = look.p2;
  s.albedo = look.rgb;
  s.gloss = 0.04f + 0.35f * std::pow(1 - std::fabs(dot(d, s.normal)), 4.0f);
  const bool side = std::fabs(normal.y) > 0.8f, front = normal.x > 0.3f, back = normal.x < -0.8f;
  if (p.z < 0.42f) s.albedo = grey(0.03f);
  if (look.p3 < 1.5f) {  // bus
    if (side) {
      if (p.z > 0.40f * h && p.z < 0.78f * h && std::fabs(p.x) < hl - 0.25f && fract((p.x + hl) / 1.45f) > 0.06f) shade_glass(grey(0.02f), d, s);
      else if (p.z > 0.20f * h && p.z < 0.30f * h) s.albedo = look.rgb2;
    } else if (front && p.z > 0.30f * h && p.z < 0.76f * h && std::fabs(p.y) < hw - 0.1f) {
      shade_glass(grey(0.02f), d, s);
    } else if (front && p.z >= 0.79f * h && p.z < 0.92f * h && std::fabs(p.y) < 0.7f * hw) {
      s.albedo = grey(0.015f);
      if (std::fabs(p.z - 0.855f * h) < 0.09f && hash01(ifloor(p.y * 11), ifloor(p.z * 14), 5) < 0.45f) s.emission = Vec3{0.9f, 0.5f, 0.08f} * 0.8f;
    } else if (back && p.z > 0.55f * h && p.z < 0.8f * h && std::fabs(p.y) < hw - 0.3f) {
      shade_glass(grey(0.02f), d, s);
    }
  } else {
    const float screen_lo = look.p3 > 2.5f ? 0.56f * h : 0.53f * h, screen_hi = look.p3 > 2.5f ? 0.88f * h : 0.90f * h;
    if (front && p.z > screen_lo && p.z < screen_hi && std::fabs(p.y) < hw - 0.12f) shade_glass(grey(0.02f), d, s);
    if (side) {
      const float from = look.p3 > 2.5f ? hl - 1.15f : 0.26f * hl, to = look.p3 > 2.5f ? hl - 0.25f : 0.52f * hl + 0.1f;
      if (p.x > from && p.x < to && p.z > screen_lo && p.z < screen_hi - 0.1f) shade_glass(grey(0.02f), d, s);
      for (const float seam : {0.2f, -0.35f})
        if (look.p3 < 2.5f && std::fabs(p.x - seam * hl) < 0.011f) s.albedo *= 0.4f;
    }
    if (back && look.p3 < 2.5f) {
      if (std::fabs(p.y) < 0.011f) s.albedo *= 0.4f;
      if (p.z > 0.58f * h && p.z < 0.86f * h && std::fabs(std::fabs(p.y) - 0.5f * hw) < 0.33f * hw) shade_glass(grey(0.02f), d, s);
    }
  }
  const float ay = std::fabs(p.y);
  if (front && ay > 0.62f * hw && p.z > 0.55f && p.z < 0.80f) {
    s.albedo = grey(0.7f);
    s.emission = Vec3{1.0f, 0.93f, 0.75f} * (world.light.night > 0.05f ? 2.0f : 0.1f);
  }
  if (back && ay > 0.78f * hw && p.z > 0.7f && p.z < 1.15f) {
    s.albedo = Vec3{0.36f, 0.012f, 0.012f};
    s.emission = Vec3{0.9f, 0.03f, 0.02f} * (world.light.night > 0.05f ? 0.9f : 0.06f);
  }
  if (back && ay < 0.27f && p.z > 0.5f && p.z < 0.62f) s.albedo = grey(0.66f);
}

void shade_sign(const Look& look, const Hit& hit, Surface& s) {
  if (hit.face == 0) {
    s.albedo = grey(0.30f);
    return;
  }
  const float u = hit.local.y / look.p3, v = hit.local.z / look.p1;
  const int mask = static_cast<int>(look.p0), motif = static_cast<int>(look.p2);
  s.albedo = look.rgb;
  switch (mask) {
    case kMaskDisc: {
      const float r2 = u * u + v * v;
      if (motif == 0) {  // ban: red rim, white field, dark digits
        s.albedo = r2 > 0.60f ? Vec3{0.55f, 0.02f, 0.025f} : grey(0.75f);
        if (r2 < 0.40f && std::fabs(v) < 0.36f && std::fabs(std::fabs(u) - 0.25f) < 0.15f && !(std::fabs(v) < 0.2f && std::fabs(std::fabs(u) - 0.25f) < 0.05f)) s.albedo = grey(0.03f);
      } else if (motif == 1) {  // no entry
        s.albedo = std::fabs(v) < 0.2f && std::fabs(u) < 0.72f ? grey(0.75f) : Vec3{0.52f, 0.02f, 0.03f};
      } else {  // order: arrow on blue
        s.albedo = Vec3{0.02f, 0.10f, 0.42f};
        if ((std::fabs(u) < 0.12f && v < 0.35f && v > -0.6f) || (v > 0.05f && v < 0.6f && std::fabs(u) < (0.6f - v))) s.albedo = grey(0.75f);
        if (r2 > 0.9f) s.albedo = grey(0.75f);
      }
      break;
    }
    case kMaskTriangle:
    case kMaskYield: {
      const float edge = (mask == kMaskTriangle ? (1 - v) : (1 + v)) * 0.5f - std::fabs(u), base = mask == kMaskTriangle ? v + 1 : 1 - v;
      s.albedo = edge < 0.2f || base < 0.26f ? Vec3{0.55f, 0.02f, 0.025f} : grey(0.75f);
      if (mask == kMaskTriangle && std::fabs(u) < 0.08f && v > -0.55f && v < 0.2f) s.albedo = grey(0.03f);
      break;
    }
    case kMaskOctagon: {
      const float rim = std::max(std::max(std::fabs(u), std::fabs(v)), (std::fabs(u) + std::fabs(v)) / 1.41f);
      s.albedo = rim > 0.92f ? grey(0.75f) : Vec3{0.50f, 0.015f, 0.025f};
      if (std::fabs(v) < 0.24f && std::fabs(u) < 0.72f && fract((u + 0.75f) * 2.6f) < 0.62f) s.albedo = grey(0.75f);
      break;
    }
    case kMaskDiamond: s.albedo = std::fabs(u) + std::fabs(v) > 0.72f ? grey(0.75f) : Vec3{0.68f, 0.42f, 0.02f}; break;
    default:
      if (std::max(std::fabs(u), std::fabs(v)) > 0.93f) s.albedo = look.rgb2;
      if (motif == 8) {  // direction board: rows of letters
        const float row = fract(v * 1.6f + 0.3f);
        if (row > 0.3f && row < 0.62f && std::fabs(u) < 0.8f && hash01(ifloor(u * 14), ifloor(v * 1.6f + 0.3f), static_cast<int>(look.seed)) < 0.62f) s.albedo = look.rgb2;
      } else if (motif == 9) {
        if (std::fabs(v) < 0.45f && std::fabs(u) < 0.8f && hash01(ifloor(u * 9), 0, static_cast<int>(look.seed)) < 0.6f) s.albedo = look.rgb2;
      } else if (std::fabs(u) < 0.5f && std::fabs(v) < 0.6f && hash01(ifloor(u * 4 + 9), ifloor(v * 3 + 9), static_cast<int>(look.seed)) < 0.5f) {
        s.albedo = look.rgb2;
      }
  }
}

void shade_foliage(const World& world, const Look& look, const Hit& hit, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  const Vec3 p = hit.local;
  const Shape& crown = world.shapes[hit.prim];
  const float leaf = crown.type == kEllipsoid ? 0.4f + 0.5f * noise2(p.x * 0.3f + p.z, p.y * 0.3f - p.z, seed + 1) : hit.part * (1.0f / 255.0f);
  if (crown.type == kLeafEllipsoid) {
    const Vec3 out = normalize(Vec3{p.x / square(crown.half.x), p.y / square(crown.half.y), p.z / square(crown.half.z)});
    s.normal = normalize(hit.normal * 0.6f + from_yaw_frame(out, crown.cs, crown.sn));
  }
  const float clump = noise2(p.x * 1.1f + p.z * 0.7f, p.y * 1.1f - p.z * 0.4f, seed);
  s.albedo = look.rgb * (0.55f + 0.55f * leaf + 0.45f * clump);
  s.albedo.x *= 0.9f + 0.35f * clump;
  s.thin = 0.35f;
  s.occlusion = 0.55f + 0.45f * leaf;
}

void shade_tyre(const World& world, const Look& look, const Hit& hit, Surface& s) {
  const Vec3 p = hit.local;
  if (hit.face == 4 || hit.face == 5) {
    const Shape& shape = world.shapes[hit.prim];
    const Vec3 q = p - shape.half * hit.wall_u;
    const float r = std::sqrt(dot(q, q)) / shape.p1;
    if (r < 0.66f) {
      const float angle = std::atan2(q.z, q.x);
      const bool spoke = std::fabs(fract(angle * (5.0f / (2 * kPi))) - 0.5f) < 0.30f || r > 0.58f || r < 0.16f;
      s.albedo = spoke ? look.rgb2 : grey(0.03f);
      s.gloss = 0.08f;
    }
  }
}

void shade_cargo(const World& world, const Look& look, const Hit& hit, float fp, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  const Vec3 p = hit.local;
  const float tone = 1 + 0.12f * fbm_filtered(p.x, p.z, 0.7f, fp, seed);
  s.albedo = look.rgb * tone;
  if (hit.face / 2 == 1 && fract(p.x / 0.55f) < 0.04f) s.albedo *= 0.82f;
  if (hit.face == 0) {
    if (std::fabs(p.y) < 0.012f) s.albedo *= 0.4f;
    const Shape& shape = world.shapes[hit.prim];
    if (p.z < -shape.half.z + 0.16f) s.albedo = std::fabs(p.y) > 0.75f * shape.half.y ? Vec3{0.4f, 0.015f, 0.015f} : grey(0.05f);
  }
  if (hit.face / 2 == 1 && hash01(seed, 8, 8) < 0.5f && std::fabs(p.z) < 0.35f && std::fabs(p.x) < 1.6f) s.albedo = Vec3{0.5f * hash01(seed, 1, 2), 0.3f * hash01(seed, 1, 3), 0.5f * hash01(seed, 1, 4)};
}

void shade_wood(const Look& look, const Hit& hit, float fp, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  const Vec3 p = hit.local;
  const float plank = std::floor(p.x / 0.14f);
  s.albedo = look.rgb * (1 + 0.35f * (hash01(static_cast<int>(plank), 2, seed) - 0.5f) * clamp01(1.4f - fp * 5) + 0.3f * noise_filtered(p.x * 5, p.z * 0.6f, 4.0f, fp, seed));
  if (fract(p.x / 0.14f) < 0.07f) s.albedo *= 0.55f;
}

void shade_tiles(const Look& look, Vec3 point, float fp, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  if (std::fabs(s.normal.z) > 0.2f) {
    const float row = point.z / 0.17f, tone = 1 + 0.3f * (hash01(ifloor(row), ifloor((point.x + point.y) * 2.2f), seed) - 0.5f) * clamp01(1.5f - fp * 4);
    s.albedo = look.rgb * tone;
    if (fract(row) < 0.12f) s.albedo *= 1 - 0.35f * clamp01(1.3f - fp * 4);
  } else {
    s.albedo = mix(look.rgb, grey(0.45f), 0.8f);
  }
}

void shade_shop_sign(const World& world, const Look& look, const Hit& hit, Surface& s) {
  const int seed = static_cast<int>(look.seed);
  const Vec3 p = hit.local;
  s.albedo = look.rgb;
  const Shape& shape = world.shapes[hit.prim];
  const float half = hit.face / 2 == 1 ? shape.half.x : shape.half.y, u = (hit.face / 2 == 1 ? p.x : p.y) / half, v = p.z / shape.half.z;
  const Vec3 ink = dot(look.rgb, grey(0.33f)) > 0.25f ? grey(0.03f) : grey(0.75f);
  if (std::fabs(u) < 0.62f && std::fabs(v) < 0.5f && hash01(ifloor(u * 10 * half), ifloor(v * 2), seed) < 0.55f && fract(u * 10 * half) > 0.25f) s.albedo = ink;
  s.emission = s.albedo * (0.9f * world.light.night);
}

}  // namespace

// Light of the sky in a mirrored direction; what stands along the street darkens it near the horizon.
Vec3 mirrored_sky(const World& world, Vec3 direction) {
  Vec3 sky = sky_radiance(world, direction, false);
  const float up = smoothstep(0.02f, 0.45f, direction.z + 0.04f * std::sin(9.0f * direction.x) * std::cos(7.0f * direction.y));
  return mix(world.light.ambient * 0.22f, sky, up);
}

Surface shade_surface(const World& world, const Hit& hit, Vec3 point, Vec3 d, float fp) {
  const Look& look = world.looks[hit.prim];
  Surface s;
  s.cls = look.cls;
  s.normal = hit.normal;
  s.albedo = look.rgb;
  const int seed = static_cast<int>(look.seed);
  const Vec3 p = hit.local;
  switch (look.material) {
    case kMatFacade: shade_facade(world, look, hit, d, fp, s); break;
    case kMatFoliage: shade_foliage(world, look, hit, s); break;
    case kMatBark: s.albedo = look.rgb * (1 + 0.9f * noise_filtered(p.x * 6 + p.y * 6, point.z, 2.2f, fp, seed)); break;
    case kMatMetal: s.gloss = 0.06f; break;
    case kMatCarBody: shade_car_body(world, look, hit, d, s); break;
    case kMatCarCabin: shade_car_cabin(look, hit, d, s); break;
    case kMatTyre: shade_tyre(world, look, hit, s); break;
    case kMatBus: shade_big_vehicle(world, look, hit, hit.normal, d, s); break;
    case kMatCargo: shade_cargo(world, look, hit, fp, s); break;
    case kMatBrick: shade_brick(look, hit.face / 2 == 0 ? p.y : p.x, p.z + 3, fp, s); break;
    case kMatWood: shade_wood(look, hit, fp, s); break;
    case kMatSign: shade_sign(look, hit, s); break;
    case kMatSignal:
      if (look.p0 > 0.5f) s.emission = look.rgb * 2.2f;
      else s.albedo = look.rgb * 0.09f;
      break;
    case kMatLampHead: s.emission = Vec3{1.0f, 0.82f, 0.55f} * (world.light.night * 2.5f); break;
    case kMatRoofTiles: shade_tiles(look, point, fp, s); break;
    case kMatCloth: s.albedo = look.rgb * (1 + 0.35f * noise_filtered(p.x * 3 + p.y * 2, p.z * 3, 3.0f, fp, seed)); break;
    case kMatShopSign: shade_shop_sign(world, look, hit, s); break;
    case kMatConcrete: s.albedo = look.rgb * (1 + 0.4f * fbm_filtered(point.x + point.y, point.z, 0.9f, fp, seed)); break;
    case kMatAwning:
      if (fract((point.x + point.y) / 0.5f) < 0.5f) s.albedo = grey(0.6f);
      s.thin = 0.2f;
      break;
    default: break;
  }
  const auto wear = [&](TextureSlot slot, Vec3 at) {
    if (!world.textures[slot].empty()) s.albedo = s.albedo * textured(world, slot, at, hit.normal, fp);
  };
  switch (look.material) {
    case kMatFacade:
      if (hit.part == kPartWall && hit.face < 4) wear(look.p0 > 0.5f ? kTexBrick : kTexPlaster, point);
      break;
    case kMatBrick: wear(kTexBrick, point); break;
    case kMatConcrete: wear(kTexConcrete, point); break;
    case kMatBark: wear(kTexBark, point); break;
    case kMatRoofTiles: wear(kTexRoof, point); break;
    case kMatCargo: wear(kTexCargo, p); break;
    default: break;
  }
  return s;
}

Vec3 sky_radiance(const World& world, Vec3 d, bool with_sun) {
  const Light& light = world.light;
  if (!world.textures[kTexSky].empty()) return world.textures[kTexSky].toward(d);
  const float up = std::max(d.z, 0.0f);
  Vec3 color = mix(light.horizon, light.zenith, 1 - std::exp(-3.2f * up));
  const float toward = dot(d, light.sun_dir);
  const float sun_level = std::min(1.0f, light.sun.y * 0.4f);
  if (toward > 0) {
    const float glow = toward * toward;
    color += light.sun * (0.06f * glow * glow * glow * glow + 0.10f * std::pow(toward, 60.0f));
  }
  if (light.cloudiness > 0.02f && d.z > 0.005f) {
    const float k = 1.0f / (d.z + 0.10f);
    const float x = d.x * k, y = d.y * k;
    float n = 0.52f * noise2(x * 0.8f, y * 0.8f, world.seed + 70) + 0.26f * noise2(x * 1.9f, y * 1.9f, world.seed + 71) +
              0.14f * noise2(x * 4.3f, y * 4.3f, world.seed + 72) + 0.08f * noise2(x * 9.7f, y * 9.7f, world.seed + 73);
    const float edge = 0.74f - 0.42f * light.cloudiness;
    const float cover = smoothstep(edge, edge + 0.22f, n) * smoothstep(0.0f, 0.12f, d.z);
    const float thick = smoothstep(edge + 0.1f, edge + 0.4f, n);
    const Vec3 cloud = light.cloud * (1.0f - 0.30f * thick) + light.sun * (0.08f * sun_level * std::max(0.0f, toward));
    color = mix(color, cloud, 0.9f * cover);
  }
  if (with_sun && light.sun.y > 0.2f && toward > 0.9994f) color = color + light.sun * 6.0f;
  return color;
}

Vec3 tone_map(const Light& light, Vec3 radiance, float vignette_r2) {
  const float falloff = light.exposure * (1 - light.vignette * vignette_r2);
  const Vec3 c = radiance * light.white * falloff;
  const auto curve = [&](float v) {
    v = std::max(v, 0.0f);
    const float filmic = (v * (2.51f * v + 0.03f)) / (v * (2.43f * v + 0.59f) + 0.14f);
    return clamp01(filmic);
  };
  Vec3 out{curve(c.x), curve(c.y), curve(c.z)};
  const float luma = 0.299f * out.x + 0.587f * out.y + 0.114f * out.z;
  out = mix(grey(luma), out, light.saturation);
  const auto encode = [&](float v) {
    v = clamp01(v);
    v = v <= 0.0031308f ? 12.92f * v : 1.055f * std::pow(v, 1 / 2.4f) - 0.055f;
    return clamp01(0.5f + (v - 0.5f) * light.contrast);
  };
  return {encode(out.x), encode(out.y), encode(out.z)};
}

}  // namespace mudg::city
