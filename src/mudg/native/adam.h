// One step of Adam (Kingma & Ba 2015) over an array, or over the visible rows of a table.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Moments below this are set to zero: they have no effect, and arithmetic on denormal numbers is slow.
constexpr float kTinyMoment = 1e-37f;

struct AdamLanes {
  Floats parameter, moment1, moment2;
};
MUDG_INLINE AdamLanes adam_lanes(const AdamJob& job, Floats parameter, Floats gradient, Floats moment1,
                                 Floats moment2) {
  const Floats tiny = splat(kTinyMoment);
  moment1 = mul_add(splat(1.0f - job.beta1), gradient - moment1, moment1);
  moment2 = mul_add(splat(1.0f - job.beta2), gradient * gradient, splat(job.beta2) * moment2);
  moment1 = keep(abs_of(moment1) >= tiny, moment1);
  moment2 = keep(moment2 >= tiny, moment2);
  const Floats root = mul_add(sqrt_of(moment2), splat(job.inv_root_bias2), splat(job.epsilon));
  return {parameter - splat(job.step_size) * moment1 / root, moment1, moment2};
}

MUDG_INLINE void adam_range(const AdamJob& job, std::size_t begin, std::size_t end) {
  std::size_t i = begin;
  for (; i + kLanes <= end; i += kLanes) {
    const AdamLanes next = adam_lanes(job, load_unaligned(job.parameter + i), load_unaligned(job.gradient + i),
                                      load_unaligned(job.moment1 + i), load_unaligned(job.moment2 + i));
    store_unaligned(job.parameter + i, next.parameter);
    store_unaligned(job.moment1 + i, next.moment1);
    store_unaligned(job.moment2 + i, next.moment2);
  }
  if (i == end) return;
  const std::size_t bytes =
      (end - i) * sizeof(float);  // the rest through copies, so that every element sees the same arithmetic
  alignas(64) float p[kLanes] = {}, g[kLanes] = {}, m[kLanes] = {}, v[kLanes] = {};
  std::memcpy(p, job.parameter + i, bytes);
  std::memcpy(g, job.gradient + i, bytes);
  std::memcpy(m, job.moment1 + i, bytes);
  std::memcpy(v, job.moment2 + i, bytes);
  const AdamLanes next = adam_lanes(job, load(p), load(g), load(m), load(v));
  store(p, next.parameter);
  store(m, next.moment1);
  store(v, next.moment2);
  std::memcpy(job.parameter + i, p, bytes);
  std::memcpy(job.moment1 + i, m, bytes);
  std::memcpy(job.moment2 + i, v, bytes);
}

void adam(const AdamJob& job) {
  const std::size_t columns = job.columns;
  const std::int64_t grain = static_cast<std::int64_t>(larger<std::size_t>(1, 16384 / columns));
  parallel_for(job.rows, grain, [&](std::int64_t begin, std::int64_t end, int) {
    if (job.visible == nullptr) return adam_range(job, begin * columns, end * columns);
    for (std::int64_t row = begin; row < end;) {
      if (!job.visible[row]) {
        ++row;
        continue;
      }
      const std::int64_t first = row;
      while (row < end && job.visible[row]) ++row;
      adam_range(job, first * columns, row * columns);
    }
  });
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
