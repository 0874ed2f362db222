// One step of Adam (Kingma & Ba 2015) over the columns of a table, or over its visible rows.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Moments below this are set to zero: they have no effect, and arithmetic on denormal numbers is slow.
constexpr float kTinyMoment = 1e-37f;

constexpr int kAdamBlock = 256;           // rows whose runs of visible ones are noted at a time
constexpr std::size_t kAdamGrain = 16384;  // elements per piece of work

struct AdamLanes {
  Floats parameter, moment1, moment2;
};
MUDG_INLINE AdamLanes adam_lanes(const AdamJob& job, Floats step_size, Floats parameter, Floats gradient,
                                 Floats moment1, Floats moment2) {
  const Floats tiny = splat(kTinyMoment);
  moment1 = mul_add(splat(1.0f - job.beta1), gradient - moment1, moment1);
  moment2 = mul_add(splat(1.0f - job.beta2), gradient * gradient, splat(job.beta2) * moment2);
  moment1 = keep(abs_of(moment1) >= tiny, moment1);
  moment2 = keep(moment2 >= tiny, moment2);
  const Floats root = mul_add(sqrt_of(moment2), splat(job.inv_root_bias2), splat(job.epsilon));
  return {parameter - step_size * moment1 / root, moment1, moment2};
}

MUDG_INLINE void adam_range(const AdamJob& job, const AdamColumn& column, std::size_t begin, std::size_t end) {
  const Floats step_size = splat(column.step_size);
  float *parameter = column.parameter, *moment1 = column.moment1, *moment2 = column.moment2;
  std::size_t i = begin;
  for (; i + kLanes <= end; i += kLanes) {
    const AdamLanes next = adam_lanes(job, step_size, load_unaligned(parameter + i), load_unaligned(column.gradient + i),
                                      load_unaligned(moment1 + i), load_unaligned(moment2 + i));
    store_unaligned(parameter + i, next.parameter);
    store_unaligned(moment1 + i, next.moment1);
    store_unaligned(moment2 + i, next.moment2);
  }
  if (i == end) return;
  const int left = static_cast<int>(end - i);
  const AdamLanes next = adam_lanes(job, step_size, load_first(parameter + i, left), load_first(column.gradient + i, left),
                                    load_first(moment1 + i, left), load_first(moment2 + i, left));
  store_first(parameter + i, left, next.parameter);
  store_first(moment1 + i, left, next.moment1);
  store_first(moment2 + i, left, next.moment2);
}

// All columns of a few rows: the runs of visible rows are looked for once, not once per column.
MUDG_INLINE void adam_block(const AdamJob& job, std::int64_t begin, std::int64_t end) {
  std::int64_t first[kAdamBlock / 2 + 1], after[kAdamBlock / 2 + 1];
  int runs = 0;
  if (job.visible == nullptr) {
    first[0] = begin;
    after[0] = end;
    runs = 1;
  } else {
    for (std::int64_t row = begin; row < end;) {
      if (!job.visible[row]) {
        ++row;
        continue;
      }
      first[runs] = row;
      while (row < end && job.visible[row]) ++row;
      after[runs++] = row;
    }
  }
  for (int c = 0; c < job.column_count; ++c) {
    const AdamColumn& column = job.columns[c];
    const std::int64_t width = column.width;
    for (int run = 0; run < runs; ++run) {
      adam_range(job, column, static_cast<std::size_t>(first[run] * width), static_cast<std::size_t>(after[run] * width));
    }
  }
}

void adam(const AdamJob& job) {
  std::size_t width = 1;
  for (int c = 0; c < job.column_count; ++c) width += static_cast<std::size_t>(job.columns[c].width);
  const std::int64_t grain = static_cast<std::int64_t>(larger<std::size_t>(1, kAdamGrain / width));
  parallel_for(job.rows, grain, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t row = begin; row < end; row += kAdamBlock) adam_block(job, row, smaller(end, row + kAdamBlock));
  });
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
