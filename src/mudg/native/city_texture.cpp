// Photographic surfaces and skies of the city. A city without them never comes here.
#include "city_world.h"

namespace mudg::city {
namespace {

// Bilinear; repeated in x, and in y too unless `clamped`.
Vec3 bilinear(const Texture::Level& level, float x, float y, bool clamped) {
  const float fx = x * level.width - 0.5f, fy = y * level.height - 0.5f;
  const int ix = ifloor(fx), iy = ifloor(fy);
  const auto wrap = [](int i, int n) { return ((i % n) + n) % n; };
  const auto row = [&](int i) { return clamped ? std::min(std::max(i, 0), level.height - 1) : wrap(i, level.height); };
  const auto texel = [&](int i, int j) { return level.texels[static_cast<size_t>(row(j)) * level.width + wrap(i, level.width)]; };
  return mix(mix(texel(ix, iy), texel(ix + 1, iy), fx - ix), mix(texel(ix, iy + 1), texel(ix + 1, iy + 1), fx - ix), fy - iy);
}

}  // namespace

void fill_texture(Texture& texture, const float* rgb, int width, int height, float metres) {
  texture.metres = metres;
  texture.levels.assign(1, {});
  Texture::Level& first = texture.levels[0];
  first.width = width;
  first.height = height;
  first.texels.resize(static_cast<size_t>(width) * height);
  for (size_t i = 0; i < first.texels.size(); ++i) first.texels[i] = {rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]};
  while (texture.levels.back().width > 1 && texture.levels.back().height > 1) {
    const Texture::Level& fine = texture.levels.back();
    Texture::Level half;
    half.width = fine.width / 2;
    half.height = fine.height / 2;
    for (int y = 0; y < half.height; ++y)
      for (int x = 0; x < half.width; ++x) {
        const Vec3* a = &fine.texels[static_cast<size_t>(2 * y) * fine.width + 2 * x];
        half.texels.push_back((a[0] + a[1] + a[fine.width] + a[fine.width + 1]) * 0.25f);
      }
    texture.levels.push_back(std::move(half));
  }
}

Vec3 Texture::at(float u, float v, float footprint_m) const {
  const float texels = std::max(1.0f, footprint_m / metres * levels[0].width), level = std::min(std::log2(texels), levels.size() - 1.001f);
  const int below = std::max(0, static_cast<int>(level));
  const float x = fract(u / metres), y = fract(v / metres);
  const Vec3 fine = bilinear(levels[below], x, y, false);
  return below + 1 < static_cast<int>(levels.size()) ? mix(fine, bilinear(levels[below + 1], x, y, false), level - below) : fine;
}

Vec3 Texture::toward(Vec3 d) const {
  const float azimuth = std::atan2(d.y, d.x) * (0.5f / kPi), elevation = std::asin(std::min(1.0f, std::max(0.0f, d.z))) * (2 / kPi);
  return bilinear(levels[0], fract(azimuth), 1 - elevation, true);
}

// The axis that the surface faces most decides from which side the picture lies on it.
Vec3 textured(const World& world, TextureSlot slot, Vec3 p, Vec3 n, float footprint_m) {
  const Texture& texture = world.textures[slot];
  if (texture.empty()) return {1, 1, 1};
  if (std::fabs(n.z) > std::max(std::fabs(n.x), std::fabs(n.y))) return texture.at(p.x, p.y, footprint_m);
  return texture.at(p.x * -n.y + p.y * n.x, p.z, footprint_m);
}

}  // namespace mudg::city
