// Four-wide bounding volume hierarchy over any items with boxes; build is deterministic, traversal is front to back.
#pragma once
#include <vector>

#include "city_math.h"

#if defined(__SSE2__) || defined(_M_X64)
#include <emmintrin.h>
#endif

namespace mudg::city {

struct Ray {
  Vec3 o, d, inv;
  Ray(Vec3 origin, Vec3 direction) : o(origin), d(direction) {
    const auto safe = [](float v) { return 1.0f / (std::fabs(v) < 1e-12f ? (v < 0 ? -1e-12f : 1e-12f) : v); };
    inv = {safe(d.x), safe(d.y), safe(d.z)};
  }
};

class Bvh {
 public:
  struct alignas(16) Node {
    float lo[3][4], hi[3][4];
    int32_t child[4];  // >= 0 node; < 0 leaf: ~(first * 8 + count); empty slot: leaf of count 0
  };

  void build(const std::vector<Aabb>& boxes) {
    nodes_.clear();
    order_.resize(boxes.size());
    for (size_t i = 0; i < order_.size(); ++i) order_[i] = static_cast<int>(i);
    if (boxes.empty()) return;
    centers_.resize(boxes.size());
    for (size_t i = 0; i < boxes.size(); ++i) centers_[i] = (boxes[i].lo + boxes[i].hi) * 0.5f;
    nodes_.reserve(boxes.size() / 3 + 4);
    make_node(boxes, 0, static_cast<int>(boxes.size()));
    centers_.clear();
  }
  bool empty() const { return nodes_.empty(); }

  // visit(item, t_max) -> true to stop; it may lower t_max when it finds a nearer hit.
  template <class Visit>
  bool traverse(const Ray& ray, float t_min, float& t_max, Visit&& visit) const {
    if (nodes_.empty()) return false;
    struct Entry {
      int32_t child;
      float t;
    };
    Entry stack[96];
    int top = 0;
    stack[top++] = {0, t_min};
    const bool neg[3] = {ray.inv.x < 0, ray.inv.y < 0, ray.inv.z < 0};
    while (top > 0) {
      const Entry entry = stack[--top];
      if (entry.t >= t_max) continue;
      if (entry.child < 0) {
        const int code = ~entry.child, first = code >> 3, count = code & 7;
        for (int i = 0; i < count; ++i)
          if (visit(order_[first + i], t_max)) return true;
        continue;
      }
      const Node& node = nodes_[entry.child];
      alignas(16) float tn[4];
      const int hits = slabs(node, ray, neg, t_min, t_max, tn);
      const int base = top;
      for (int k = 0; k < 4; ++k) {
        if (!(hits & (1 << k))) continue;
        int at = top++;  // keep the nearest on top of the stack
        while (at > base && stack[at - 1].t < tn[k]) {
          stack[at] = stack[at - 1];
          --at;
        }
        stack[at] = {node.child[k], tn[k]};
      }
    }
    return false;
  }

  // Calls take(item, box) for every item whose box may touch the convex region { p : dot(n, p) <= k for all planes }.
  template <class Take>
  void collect(const Vec3* normals, const float* offsets, int planes, Take&& take) const {
    if (nodes_.empty()) return;
    int32_t stack[192];
    int top = 0;
    stack[top++] = 0;
    while (top > 0) {
      const Node& node = nodes_[stack[--top]];
      for (int k = 0; k < 4; ++k) {
        if (node.child[k] == ~0) continue;
        bool outside = false;
        for (int i = 0; i < planes && !outside; ++i) {  // the corner of the box furthest inside
          const Vec3 n = normals[i];
          const Vec3 corner{n.x > 0 ? node.lo[0][k] : node.hi[0][k], n.y > 0 ? node.lo[1][k] : node.hi[1][k],
                            n.z > 0 ? node.lo[2][k] : node.hi[2][k]};
          outside = dot(n, corner) > offsets[i];
        }
        if (outside) continue;
        if (node.child[k] >= 0) {
          stack[top++] = node.child[k];
          continue;
        }
        const int code = ~node.child[k];
        const Aabb box{{node.lo[0][k], node.lo[1][k], node.lo[2][k]}, {node.hi[0][k], node.hi[1][k], node.hi[2][k]}};
        for (int i = 0; i < (code & 7); ++i) take(order_[(code >> 3) + i], box);
      }
    }
  }

  // Entry distances into the four boxes of a node; bit k of the result: box k is hit. Empty slots hold inverted boxes.
  static int slabs(const Node& node, const Ray& ray, const bool* neg, float t_min, float t_max, float* tn) {
    const float* nx = neg[0] ? node.hi[0] : node.lo[0];
    const float* fx = neg[0] ? node.lo[0] : node.hi[0];
    const float* ny = neg[1] ? node.hi[1] : node.lo[1];
    const float* fy = neg[1] ? node.lo[1] : node.hi[1];
    const float* nz = neg[2] ? node.hi[2] : node.lo[2];
    const float* fz = neg[2] ? node.lo[2] : node.hi[2];
#if defined(__SSE2__) || defined(_M_X64)
    const __m128 ox = _mm_set1_ps(ray.o.x), oy = _mm_set1_ps(ray.o.y), oz = _mm_set1_ps(ray.o.z);
    const __m128 ix = _mm_set1_ps(ray.inv.x), iy = _mm_set1_ps(ray.inv.y), iz = _mm_set1_ps(ray.inv.z);
    const auto t_of = [](const float* plane, __m128 o, __m128 inv) { return _mm_mul_ps(_mm_sub_ps(_mm_load_ps(plane), o), inv); };
    const __m128 near_t = _mm_max_ps(_mm_max_ps(t_of(nx, ox, ix), t_of(ny, oy, iy)), _mm_max_ps(t_of(nz, oz, iz), _mm_set1_ps(t_min)));
    const __m128 far_t = _mm_min_ps(_mm_min_ps(t_of(fx, ox, ix), t_of(fy, oy, iy)), _mm_min_ps(t_of(fz, oz, iz), _mm_set1_ps(t_max)));
    _mm_store_ps(tn, near_t);
    return _mm_movemask_ps(_mm_cmple_ps(near_t, far_t));
#else
    int hits = 0;
    for (int k = 0; k < 4; ++k) {
      const float ax = (nx[k] - ray.o.x) * ray.inv.x, bx = (fx[k] - ray.o.x) * ray.inv.x;
      const float ay = (ny[k] - ray.o.y) * ray.inv.y, by = (fy[k] - ray.o.y) * ray.inv.y;
      const float az = (nz[k] - ray.o.z) * ray.inv.z, bz = (fz[k] - ray.o.z) * ray.inv.z;
      tn[k] = std::max(std::max(ax, ay), std::max(az, t_min));
      const float far_t = std::min(std::min(bx, by), std::min(bz, t_max));
      hits |= (tn[k] <= far_t) << k;
    }
    return hits;
#endif
  }

 private:
  // Splits [first, last) in two by the binned surface-area heuristic; returns the middle.
  int split(const std::vector<Aabb>& boxes, int first, int last) {
    Aabb span;
    for (int i = first; i < last; ++i) span.grow(centers_[order_[i]]);
    const Vec3 e = span.hi - span.lo;
    const int axis = e.x >= e.y ? (e.x >= e.z ? 0 : 2) : (e.y >= e.z ? 1 : 2);
    const float lo = axis == 0 ? span.lo.x : (axis == 1 ? span.lo.y : span.lo.z);
    const float extent = axis == 0 ? e.x : (axis == 1 ? e.y : e.z);
    const auto value = [&](int item) {
      const Vec3& c = centers_[item];
      return axis == 0 ? c.x : (axis == 1 ? c.y : c.z);
    };
    constexpr int kBins = 12;
    const int middle = (first + last) / 2;
    if (extent < 1e-6f) return middle;
    Aabb bin_box[kBins];
    int bin_count[kBins] = {};
    const auto bin_of = [&](int item) { return std::min(kBins - 1, static_cast<int>((value(item) - lo) / extent * kBins)); };
    for (int i = first; i < last; ++i) {
      const int b = bin_of(order_[i]);
      bin_box[b].grow(boxes[order_[i]]);
      ++bin_count[b];
    }
    float right_cost[kBins];
    Aabb sweep;
    int count = 0;
    for (int b = kBins - 1; b > 0; --b) {
      sweep.grow(bin_box[b]);
      count += bin_count[b];
      right_cost[b] = count ? sweep.half_area() * count : 0;
    }
    sweep = Aabb{};
    count = 0;
    int best = -1;
    float best_cost = kInf;
    for (int b = 1; b < kBins; ++b) {
      sweep.grow(bin_box[b - 1]);
      count += bin_count[b - 1];
      if (count == 0 || count == last - first) continue;
      const float cost = sweep.half_area() * count + right_cost[b];
      if (cost < best_cost) {
        best_cost = cost;
        best = b;
      }
    }
    if (best < 0) return middle;
    const auto it = std::stable_partition(order_.begin() + first, order_.begin() + last,
                                          [&](int item) { return bin_of(item) < best; });
    return static_cast<int>(it - order_.begin());
  }

  int make_node(const std::vector<Aabb>& boxes, int first, int last) {
    const int index = static_cast<int>(nodes_.size());
    nodes_.emplace_back();
    int cut[5] = {first, last, last, last, last};
    int parts = 1;
    while (parts < 4) {  // split the largest part until four
      int widest = 0;
      for (int p = 1; p < parts; ++p)
        if (cut[p + 1] - cut[p] > cut[widest + 1] - cut[widest]) widest = p;
      if (cut[widest + 1] - cut[widest] <= 1) break;
      const int middle = split(boxes, cut[widest], cut[widest + 1]);
      for (int p = parts; p > widest; --p) cut[p + 1] = cut[p];
      cut[widest + 1] = middle;
      ++parts;
    }
    for (int k = 0; k < 4; ++k) {
      int32_t child = ~0;
      Aabb box;
      if (k < parts) {
        for (int i = cut[k]; i < cut[k + 1]; ++i) box.grow(boxes[order_[i]]);
        const int count = cut[k + 1] - cut[k];
        child = count <= 1 ? ~(cut[k] * 8 + count) : make_node(boxes, cut[k], cut[k + 1]);
      }
      Node& node = nodes_[index];
      node.child[k] = child;
      const float lo[3] = {box.lo.x, box.lo.y, box.lo.z}, hi[3] = {box.hi.x, box.hi.y, box.hi.z};
      for (int a = 0; a < 3; ++a) {
        node.lo[a][k] = lo[a];
        node.hi[a][k] = hi[a];
      }
    }
    return index;
  }

  std::vector<Node> nodes_;
  std::vector<int> order_;
  std::vector<Vec3> centers_;
};

}  // namespace mudg::city
