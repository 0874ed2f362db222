// (1 - w) mean |x - y| + w (1 - mean SSIM) of planar images, and its gradient with respect to x, in two sweeps. With a
// weight for every pixel: the mean over all pixels of weight times (1 - w) |x - y| + w (1 - SSIM).
//
// SSIM as usual: 11x11 Gaussian window of sigma 1.5 px, zero padding, C1 = 0.01^2, C2 = 0.03^2. The window is
// separable: rows are blurred into a ring of eleven, which is then blurred across. The first sweep leaves the
// derivatives of SSIM with respect to the three blurred quantities that depend on x (mean, E[x^2 + y^2], E[x y]); the
// second blurs those once more and assembles the gradient.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

constexpr int kTaps = 11, kReach = 5;
constexpr float kWindow[kReach + 1] = {0.26601172486179436f, 0.21300553771125370f, 0.10936068950970002f,
                                       0.03600077212843083f, 0.00759875813523919f, 0.00102838008447911f};

// A symmetric filter along a row; `p` points at the centre tap of lane 0.
MUDG_INLINE Floats blur_row(const float* p) {
  Floats total = splat(kWindow[0]) * load_unaligned(p);
  for (int k = 1; k <= kReach; ++k)
    total = mul_add(splat(kWindow[k]), load_unaligned(p - k) + load_unaligned(p + k), total);
  return total;
}

// The same across eleven rows, at column `at`.
MUDG_INLINE Floats blur_column(const float* const* rows, int at) {
  Floats total = splat(kWindow[0]) * load_unaligned(rows[kReach] + at);
  for (int k = 1; k <= kReach; ++k) {
    total = mul_add(splat(kWindow[k]), load_unaligned(rows[kReach - k] + at) + load_unaligned(rows[kReach + k] + at),
                    total);
  }
  return total;
}

// The last eleven rows of kQuantities blurred quantities.
template <int kQuantities>
struct RowRing {
  float* memory;
  int width;  // padded
  MUDG_INLINE float* row(int y, int quantity) const {
    return memory + static_cast<std::size_t>(((y + kTaps) % kTaps) * kQuantities + quantity) * width;
  }
  MUDG_INLINE void clear(int y) const { std::memset(row(y, 0), 0, sizeof(float) * kQuantities * width); }
  // Addresses of rows y - 5 .. y + 5 of one quantity.
  MUDG_INLINE void around(int y, int quantity, const float** rows) const {
    for (int k = 0; k < kTaps; ++k) rows[k] = row(y - kReach + k, quantity);
  }
};

// Blurs x, y, x^2 + y^2, x y of one image row into the ring (SSIM needs the variances' sum only). `raw` holds four
// padded rows whose aprons are zero.
MUDG_INLINE void blur_inputs(const PhotometricJob& job, const float* x, const float* y, float* raw,
                             const RowRing<4>& ring, int at) {
  const int padded = job.row_stride;
  float* inside = raw + kPhotometricApron;
  for (int i = 0; i < job.width; ++i) {
    inside[i] = x[i];
    inside[padded + i] = y[i];
    inside[2 * padded + i] = x[i] * x[i] + y[i] * y[i];
    inside[3 * padded + i] = x[i] * y[i];
  }
  for (int q = 0; q < 4; ++q) {
    float* out = ring.row(at, q);
    for (int i = 0; i < ring.width; i += kLanes) store_unaligned(out + i, blur_row(inside + q * padded + i));
  }
}

// Weights of the pixels from column `at` of a row; 0 beyond its end.
MUDG_INLINE Floats weight_at(const PhotometricJob& job, int y, int at) {
  const int count = smaller(kLanes, job.width - at);
  if (count <= 0) return splat(0.0f);
  if (job.weight == nullptr) return keep(first_lanes(count), splat(1.0f));
  return load_first(job.weight + static_cast<std::size_t>(y) * job.width + at, count);
}

// SSIM at sixteen pixels, and its derivatives with respect to the blurred x, x^2 and x y.
struct SsimTerms {
  Floats value, of_mean, of_square, of_product;
};
MUDG_INLINE SsimTerms ssim_terms(Floats mean_x, Floats mean_y, Floats squares, Floats product) {
  const Floats two = splat(2.0f), c1 = splat(1e-4f), c2 = splat(9e-4f);
  const Floats variances = neg_mul_add(mean_x, mean_x, neg_mul_add(mean_y, mean_y, squares));  // of x plus of y
  const Floats covariance = product - mean_x * mean_y;
  const Floats a = mul_add(mean_x * mean_y, two, c1), b = mul_add(covariance, two, c2);
  const Floats inv_c = splat(1.0f) / mul_add(mean_x, mean_x, mul_add(mean_y, mean_y, c1));
  const Floats inv_d = splat(1.0f) / (variances + c2);
  const Floats value = a * b * inv_c * inv_d;
  const Floats of_mean = two * (mean_y * (b - a) * inv_c * inv_d + mean_x * value * (inv_d - inv_c));
  return {value, of_mean, splat(0.0f) - value * inv_d, two * a * inv_c * inv_d};
}

// First sweep over a strip of rows of one plane: SSIM and its derivative maps. Returns the sum of SSIM - 1, weighted.
double ssim_strip(const PhotometricJob& job, int plane, int y0, int y1, float* scratch) {
  const std::size_t offset = static_cast<std::size_t>(plane) * job.height;
  const RowRing<4> ring = {scratch + 4 * job.row_stride, job.padded_width};
  std::memset(scratch, 0, sizeof(float) * 4 * job.row_stride);
  const auto fetch = [&](int y) {
    if (y < 0 || y >= job.height) return ring.clear(y);
    const std::size_t at = (offset + y) * job.width;
    blur_inputs(job, job.x + at, job.y + at, scratch, ring, y);
  };
  for (int y = y0 - kReach; y < y0 + kReach; ++y) fetch(y);
  double total = 0.0;
  for (int y = y0; y < y1; ++y) {
    fetch(y + kReach);
    const float* rows[4][kTaps];
    for (int q = 0; q < 4; ++q) ring.around(y, q, rows[q]);
    float* maps[3];
    for (int m = 0; m < 3; ++m) {
      maps[m] = job.maps + (static_cast<std::size_t>(m) * job.planes * job.height + offset + y) * job.row_stride;
      std::memset(maps[m], 0, sizeof(float) * kPhotometricApron);
      std::memset(maps[m] + kPhotometricApron + job.padded_width, 0, sizeof(float) * kPhotometricApron);
    }
    Floats sums = splat(0.0f);
    for (int i = 0; i < job.padded_width; i += kLanes) {
      const SsimTerms s = ssim_terms(blur_column(rows[0], i), blur_column(rows[1], i), blur_column(rows[2], i),
                                     blur_column(rows[3], i));
      const Floats weight = weight_at(job, y, i);  // 0 beyond the row
      sums = mul_add(weight, s.value - splat(1.0f), sums);
      store_unaligned(maps[0] + kPhotometricApron + i, weight * s.of_mean);
      store_unaligned(maps[1] + kPhotometricApron + i, weight * s.of_square);
      store_unaligned(maps[2] + kPhotometricApron + i, weight * s.of_product);
    }
    total += sum(sums);
  }
  return total;
}

// Second sweep: blurs the derivative maps and writes the gradient. Returns the sum of absolute differences, weighted.
double gradient_strip(const PhotometricJob& job, int plane, int y0, int y1, float* scratch) {
  const std::size_t offset = static_cast<std::size_t>(plane) * job.height;
  const RowRing<3> ring = {scratch, job.padded_width};
  const auto fetch = [&](int y) {
    if (y < 0 || y >= job.height) return ring.clear(y);
    for (int m = 0; m < 3; ++m) {
      const float* map = job.maps +
                         (static_cast<std::size_t>(m) * job.planes * job.height + offset + y) * job.row_stride +
                         kPhotometricApron;
      float* out = ring.row(y, m);
      for (int i = 0; i < job.padded_width; i += kLanes) store_unaligned(out + i, blur_row(map + i));
    }
  };
  const float share =
      1.0f / (static_cast<float>(job.planes) * static_cast<float>(job.height) * static_cast<float>(job.width));
  const Floats of_l1 = splat((1.0f - job.ssim_weight) * share), of_ssim = splat(job.ssim_weight * share),
               zero = splat(0.0f);
  for (int y = y0 - kReach; y < y0 + kReach; ++y) fetch(y);
  double total = 0.0;
  for (int y = y0; y < y1; ++y) {
    fetch(y + kReach);
    const float* rows[3][kTaps];
    for (int m = 0; m < 3; ++m) ring.around(y, m, rows[m]);
    const std::size_t at = (offset + y) * job.width;
    Floats sums = zero;
    for (int i = 0; i < job.width; i += kLanes) {
      const int count = smaller(kLanes, job.width - i);
      const Floats value = load_up_to(job.x + at + i, count), wanted = load_up_to(job.y + at + i, count);
      const Floats difference = value - wanted;
      const Floats ssim = mul_add(wanted, blur_column(rows[2], i),
                                  mul_add(value + value, blur_column(rows[1], i), blur_column(rows[0], i)));
      const Floats sign = select(difference > zero, of_l1, select(difference < zero, zero - of_l1, zero));
      const Floats weight = weight_at(job, y, i);
      sums = mul_add(weight, abs_of(difference), sums);
      store_up_to(job.gradient + at + i, count, neg_mul_add(of_ssim, ssim, weight * sign));
    }
    total += sum(sums);
  }
  return total;
}

double photometric(const PhotometricJob& job) {
  const int strips = (job.height + kPhotometricStrip - 1) / kPhotometricStrip;
  const int pieces = job.planes * strips;
  for (int sweep = 0; sweep < 2; ++sweep) {
    parallel_for(
        pieces, 1,
        [&](std::int64_t begin, std::int64_t end, int worker) {
          float* scratch = job.worker_scratch + static_cast<std::size_t>(worker) * job.worker_stride;
          for (int piece = static_cast<int>(begin); piece < static_cast<int>(end); ++piece) {
            const int plane = piece / strips, y0 = piece % strips * kPhotometricStrip,
                      y1 = smaller(job.height, y0 + kPhotometricStrip);
            if (sweep == 0) {
              job.partial[piece] = -static_cast<double>(job.ssim_weight) * ssim_strip(job, plane, y0, y1, scratch);
            } else {
              job.partial[piece] +=
                  (1.0 - static_cast<double>(job.ssim_weight)) * gradient_strip(job, plane, y0, y1, scratch);
            }
          }
        },
        job.workers);
  }
  double total = 0.0;  // in a fixed order: the same value for any number of threads
  for (int piece = 0; piece < pieces; ++piece) total += job.partial[piece];
  return total / (static_cast<double>(job.planes) * job.height * job.width);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
