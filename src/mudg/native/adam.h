// One step of Adam (Kingma & Ba 2015) over the columns of a table, or over its visible rows.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Moments below this are set to zero: they have no effect, and arithmetic on denormal numbers is slow.
constexpr float kTinyMoment = 1e-37f;

constexpr int kAdamBlock = 256;           // rows whose runs of visible ones are noted at a time
constexpr std::int64_t kAdamNarrow = 16;  // columns up to this width are gone through in whole vectors
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
  for (std::size_t i = begin; i < end; i += kLanes) {
    const int count = static_cast<int>(smaller<std::size_t>(kLanes, end - i));
    const Floats gradient = load_up_to(column.gradient + i, count);
    const AdamLanes next = adam_lanes(job, step_size, load_up_to(parameter + i, count), gradient,
                                      load_up_to(moment1 + i, count), load_up_to(moment2 + i, count));
    store_up_to(parameter + i, count, next.parameter);
    store_up_to(moment1 + i, count, next.moment1);
    store_up_to(moment2 + i, count, next.moment2);
  }
}

// The rows [begin, end) of a narrow column, of which some are visible: whole vectors in which the lanes of the other
// rows keep their values. Runs of few elements, one after the other, would each wait for the store before.
MUDG_INLINE void adam_narrow(const AdamJob& job, const AdamColumn& column, std::int64_t begin, std::int64_t end) {
  alignas(64) float shown[kAdamBlock * kAdamNarrow + kLanes];
  const std::size_t width = static_cast<std::size_t>(column.width);
  for (std::int64_t row = begin; row < end; ++row)
    store_unaligned(shown + static_cast<std::size_t>(row - begin) * width, splat(job.visible[row] ? 1.0f : 0.0f));
  const Floats step_size = splat(column.step_size), half = splat(0.5f);
  const std::size_t start = static_cast<std::size_t>(begin) * width;
  const std::size_t count = static_cast<std::size_t>(end - begin) * width;
  for (std::size_t i = 0; i < count; i += kLanes) {
    const Mask moves = load(shown + i) > half;
    if (bits(moves) == 0) continue;
    float *parameter = column.parameter + start + i, *moment1 = column.moment1 + start + i;
    float* moment2 = column.moment2 + start + i;
    const float* gradient = column.gradient + start + i;
    const int left = static_cast<int>(smaller<std::size_t>(kLanes, count - i));
    const Floats p = load_up_to(parameter, left), m = load_up_to(moment1, left), v = load_up_to(moment2, left);
    const AdamLanes next = adam_lanes(job, step_size, p, load_up_to(gradient, left), m, v);
    store_up_to(parameter, left, select(moves, next.parameter, p));
    store_up_to(moment1, left, select(moves, next.moment1, m));
    store_up_to(moment2, left, select(moves, next.moment2, v));
  }
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
  const bool mixed = runs > 1;
  for (int c = 0; c < job.column_count; ++c) {
    const AdamColumn& column = job.columns[c];
    const std::int64_t width = column.width;
    if (mixed && width <= kAdamNarrow) {
      adam_narrow(job, column, begin, end);
      continue;
    }
    for (int run = 0; run < runs; ++run) {
      const auto from = static_cast<std::size_t>(first[run] * width), to = static_cast<std::size_t>(after[run] * width);
      adam_range(job, column, from, to);
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
