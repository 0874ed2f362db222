#include "city_ground.h"

namespace mudg::city {
namespace {

// Share of a pixel of size `footprint` covered by a stripe |x| < half.
float stripe(float x, float half, float footprint) {
  const float f = std::max(footprint, 1e-4f);
  return clamp01((half - std::fabs(x)) / f + 0.5f) * std::min(1.0f, 2.0f * half / f);
}

struct Paint {
  float white = 0, yellow = 0;
};

void add_marks(const Road& road, float s, float u, float fp_u, float fp_s, Paint& paint) {
  for (const LaneMark& m : road.marks) {
    const float off = u - m.u;
    if (std::fabs(off) > m.half_width + 0.4f + fp_u) continue;
    float cover = 0;
    switch (m.kind) {
      case kMarkSolid: cover = stripe(off, m.half_width, fp_u); break;
      case kMarkDashed: {
        const float along = fract(s / m.period_m) * m.period_m - 0.5f * m.dash_m;
        cover = stripe(off, m.half_width, fp_u) * stripe(along, 0.5f * m.dash_m, fp_s);
        break;
      }
      case kMarkDouble: cover = stripe(std::fabs(off) - 0.15f, m.half_width, fp_u); break;
      case kMarkHatched: {
        if (std::fabs(off) < m.half_width) {
          const float along = fract((s + 0.7f * off) / m.period_m) * m.period_m - 0.5f * m.dash_m;
          cover = stripe(along, 0.5f * m.dash_m, fp_s);
        }
        break;
      }
    }
    float& target = m.yellow ? paint.yellow : paint.white;
    target = std::max(target, cover);
  }
}

// Zebra bars and stop line at distance `along` from the start of a crossing of the given length.
float zebra(float along, float length, float across, float fp) {
  return along > 0 && along < length ? stripe(fract(across / 1.1f) * 1.1f - 0.3f, 0.27f, fp) : 0;
}

// Where a ground point lies in street coordinates.
struct Street {
  float s, u, a = 0, b = 0;  // main street; cross street
  bool in_cross = false;     // on the cross street, outside the main street
};

Vec3 asphalt_albedo(const Road& road, const Street& street, Vec3 p, float fp, float& gloss) {
  const int seed = road.seed;
  const float along = street.in_cross ? street.a : street.s, lateral = street.in_cross ? street.b : street.u;
  float tone = 1.0f + 0.55f * fbm_filtered(p.x, p.y, 0.22f, fp, seed) + 0.35f * fbm_filtered(p.x, p.y, 2.3f, fp, seed + 3);
  tone += 0.45f * noise_filtered(p.x, p.y, 17.0f, fp, seed + 4) + 0.28f * noise_filtered(p.y, p.x, 43.0f, fp, seed + 6);
  // wheel tracks run darker and smoother, the middle of a lane collects oil
  const float lane = fract(lateral / road.lane_width - 0.5f * (street.in_cross ? 0.0f : 1.0f));
  const float track = std::exp(-square((std::fabs(lane - 0.5f) - 0.24f) * 9.0f));
  tone -= 0.10f * track;
  tone -= 0.10f * std::exp(-square((lane - 0.5f) * 10.0f)) * clamp01(0.5f + noise2(along * 0.15f, lateral * 0.3f, seed + 8));
  // repaired patches with sealed edges
  const int px = ifloor(along / 6.5f), py = ifloor(lateral / 2.6f);
  if (hash01(px, py, seed + 11) < 0.22f * road.patches) {
    const float ax = fract(along / 6.5f) * 6.5f, ay = fract(lateral / 2.6f) * 2.6f;
    const float w = 2.0f + 4.0f * hash01(px, py, seed + 12), h = 0.7f + 1.7f * hash01(px, py, seed + 13);
    if (ax < w && ay < h) {
      tone *= 0.72f + 0.5f * hash01(px, py, seed + 14);
      if (std::min(std::min(ax, w - ax), std::min(ay, h - ay)) < 0.05f + 0.3f * fp) tone *= 0.75f;
    }
  }
  // cracks: zero crossings of a noise field
  const float crack_field = std::fabs(noise2(p.x * 0.33f + 5, p.y * 0.33f, seed + 15) +
                                      0.25f * noise2(p.x * 1.9f, p.y * 1.9f, seed + 16) - 0.62f);
  const float cracked = smoothstep(0.5f, 0.75f, noise2(p.x * 0.11f, p.y * 0.11f, seed + 17));
  tone *= 1.0f - cracked * (0.15f + 0.25f * road.wear) * clamp01(1.1f - crack_field * 110.0f) * clamp01(1.2f - fp * 12);
  Vec3 albedo = road.asphalt * std::max(tone, 0.25f);
  // manholes and drains
  const int mz = ifloor(along / 17.0f);
  if (hash01(mz, 3, seed + 20) < 0.6f) {
    const float mx = mix(road.right + 1.0f, road.left - 1.0f, hash01(mz, 5, seed + 20));
    const float r = std::sqrt(square(lateral - mx) + square(fract(along / 17.0f) * 17.0f - 8.0f));
    if (r < 0.36f) {
      const float rim = r > 0.30f ? 0.5f : 0.8f;
      albedo = Vec3{0.085f, 0.08f, 0.075f} * rim;
      gloss = 0.25f;
    }
  }
  return albedo;
}

// Markings, wear and the dirt in the gutter on top of the asphalt.
Vec3 painted_albedo(const Road& road, const Street& street, Vec3 albedo, Vec3 p, float fp) {
  const int seed = road.seed;
  const float s = street.s, u = street.u, a = street.a, b = street.b;
  const bool in_cross = street.in_cross, in_middle = road.has_cross && !in_cross && std::fabs(b) < road.cross_half + 0.6f;
  Paint paint;
  bool cut = in_middle || in_cross;
  for (const Crosswalk& c : road.crosswalks) {
    const float q = (c.on_cross ? a : s) - c.s, across = c.on_cross ? b : u;
    if (c.on_cross != in_cross && road.has_cross && c.on_cross) continue;
    if (q > -2.2f && q < c.length + 2.2f) {
      if (!c.on_cross) cut = true;
      paint.white = std::max(paint.white, zebra(q, c.length, across, fp));
      // stop line for the traffic that comes towards the crossing
      const bool right_half = across < 0;
      const float line = right_half != c.on_cross || !c.on_cross ? (right_half ? -1.5f : c.length + 1.5f) : -99.0f;
      const float inside = c.on_cross ? road.cross_half : (right_half ? -road.right : road.left);
      if (std::fabs(across) < inside - 0.4f) paint.white = std::max(paint.white, stripe(q - line, 0.2f, fp));
    }
  }
  if (!cut) {
    add_marks(road, s, u, fp, fp * 2, paint);
  } else if (in_cross && std::fabs(a) > 0) {
    const float to_edge = a > 0 ? a - road.left : -a + road.right;
    if (to_edge > 7.0f) {
      const float along_dash = fract(a / 6.0f) * 6.0f - 1.5f;
      paint.white = std::max(paint.white, stripe(b, 0.07f, fp) * stripe(along_dash, 1.5f, fp * 2));
    }
  }
  const float worn = noise2(p.x * 3.1f, p.y * 3.1f, seed + 21) * 0.6f + noise2(p.x * 13.0f, p.y * 13.0f, seed + 22) * 0.4f;
  const float keep = mix(1.0f, smoothstep(0.15f, 0.55f, worn), 0.75f * road.wear);
  albedo = mix(albedo, Vec3{0.52f, 0.52f, 0.50f}, 0.9f * keep * paint.white);
  albedo = mix(albedo, Vec3{0.52f, 0.34f, 0.05f}, 0.9f * keep * paint.yellow);
  // gutter dirt along the kerb
  const float k = -road.kerb_distance(u, a, b);
  albedo *= 1.0f - 0.35f * clamp01(1.0f - k / 0.35f) * (0.6f + 0.4f * worn);
  return albedo;
}

Vec3 kerb_albedo(const Road& road, const Street& street, Vec3 p, float fp) {
  const int seed = road.seed;
  const float s = street.s, u = street.u, a = street.a;
  const float along = std::fabs(u) < 40 ? s : a;
  float tone = 0.9f + 0.25f * (hash01(ifloor(along), 7, seed + 30) - 0.5f) + 0.4f * fbm_filtered(p.x, p.y, 5.0f, fp, seed + 31);
  if (fract(along) < 0.03f + fp * 0.3f) tone *= 0.8f;
  if (p.z < kKerbHeight - 0.005f) tone *= 0.62f + 0.3f * p.z / kKerbHeight;
  return road.kerb * tone;
}

// Slabs or bricks; `inner`: forecourts beyond the sidewalk carry other slabs.
Vec3 paving_albedo(const Road& road, const Street& street, Vec3 p, float fp, bool inner) {
  const int seed = road.seed;
  const float s = street.s, u = street.u;
  const float slab = road.slab;
  const float along = s, lateral = std::max(u - road.left, road.right - u);
  const float size_s = inner ? slab * 0.6f : slab, size_u = road.brick > 0.5f ? slab * 0.5f : size_s;
  const float row = std::floor(lateral / size_u);
  const float shifted = along + (road.brick > 0.5f ? 0.5f * size_s * fract(row * 0.5f) * 2 : 0);
  const int is = ifloor(shifted / size_s), iu = static_cast<int>(row);
  const float fs = fract(shifted / size_s) * size_s, fu = fract(lateral / size_u) * size_u;
  float tone = 1.0f + 0.18f * (hash01(is, iu, seed + 40) - 0.5f) * clamp01(1.5f - fp / slab);
  tone += 0.45f * fbm_filtered(p.x, p.y, 0.8f, fp, seed + 41) + 0.25f * noise_filtered(p.x, p.y, 23.0f, fp, seed + 44);
  const float joint = 0.012f + 0.35f * fp;
  if (std::min(fs, fu) < joint) tone *= 1.0f - 0.28f * std::min(1.0f, 0.024f / joint + 0.25f) ;
  // stains and gum
  const float stain = noise2(p.x * 0.9f, p.y * 0.9f, seed + 45);
  tone *= 1.0f - 0.22f * smoothstep(0.68f, 0.85f, stain);
  Vec3 color = inner ? road.sidewalk * 0.85f : road.sidewalk;
  return color * tone;
}

Vec3 terrain_albedo(const Road& road, Vec3 p, float fp) {
  const int seed = road.seed;
  const float n = fbm_filtered(p.x, p.y, 0.45f, fp, seed + 50) + 0.8f * fbm_filtered(p.x, p.y, 6.0f, fp, seed + 53);
  const float blades = noise_filtered(p.x, p.y, 31.0f, fp, seed + 56);
  const float dry = smoothstep(0.55f, 0.8f, noise2(p.x * 0.21f, p.y * 0.21f, seed + 57));
  Vec3 color = mix(road.terrain, Vec3{0.20f, 0.16f, 0.08f}, 0.5f * dry);
  return color * std::max(0.35f, 1.0f + 0.9f * n + 0.7f * blades);
}

}  // namespace

Vec3 ground_albedo(const Road& road, GroundPart& part, Vec3 p, float footprint_m, float& gloss) {
  Street street;
  road.main_coordinates(p.x, p.y, street.s, street.u);
  if (road.has_cross) road.cross_coordinates(p.x, p.y, street.a, street.b);
  const float u = street.u, a = street.a, b = street.b;
  street.in_cross = road.has_cross && (u > road.left || u < road.right);
  gloss = 0;
  if (part == kGroundRoad) return painted_albedo(road, street, asphalt_albedo(road, street, p, footprint_m, gloss), p, footprint_m);
  if (part == kGroundKerb) return kerb_albedo(road, street, p, footprint_m);
  const float k = road.kerb_distance(u, a, b);
  const bool left_side = u > 0;
  float width = left_side ? road.sidewalk_left : road.sidewalk_right;
  const bool paved = left_side ? road.paved_left : road.paved_right;
  const bool beside_cross = street.in_cross && std::fabs(b) - road.cross_half < road.cross_sidewalk && a < road.cross_to && a > road.cross_from;
  if (beside_cross) width = std::max(width, k + 0.1f);
  if (k < width || (paved && k < 40)) {
    part = kGroundSidewalk;
    return paving_albedo(road, street, p, footprint_m, k > width);
  }
  part = kGroundTerrain;
  return terrain_albedo(road, p, footprint_m);
}

}  // namespace mudg::city
