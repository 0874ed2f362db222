// A picture over a coarse one, rgb + (1 - alpha) * enlarged(coarse), and its gradient. Enlarging is bilinear between the centres
// of coarse pixels, the outermost ones go on to the border.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Where a fine row or column lies between two coarse ones.
struct Between {
  int before, after;
  float share;  // of `after`
};
MUDG_INLINE Between between(int fine, int fine_count, int coarse_count) {
  const float place = larger(
      0.0f, (static_cast<float>(fine) + 0.5f) * (static_cast<float>(coarse_count) / static_cast<float>(fine_count)) - 0.5f);
  const int before = smaller(static_cast<int>(place), coarse_count - 1);
  return {before, smaller(before + 1, coarse_count - 1), smaller(1.0f, place - static_cast<float>(before))};
}

// One row of a channel of the enlarged picture; `blended` is scratch for a coarse row.
MUDG_INLINE void enlarged_row(const OverJob& job, int channel, int y, const Between* columns, float* blended, float* out) {
  const Between row = between(y, job.height, job.coarse_height);
  const float* plane = job.coarse + static_cast<std::size_t>(channel) * job.coarse_height * job.coarse_width;
  const float* above = plane + static_cast<std::size_t>(row.before) * job.coarse_width;
  const float* below = plane + static_cast<std::size_t>(row.after) * job.coarse_width;
  for (int x = 0; x < job.coarse_width; ++x) blended[x] = above[x] + row.share * (below[x] - above[x]);
  for (int x = 0; x < job.width; ++x) {
    const Between at = columns[x];
    out[x] = blended[at.before] + at.share * (blended[at.after] - blended[at.before]);
  }
}

void over_rows(const OverJob& job, int first, int last, int worker) {
  float* scratch = job.worker_scratch + static_cast<std::size_t>(worker) * (job.coarse_width + job.width);
  const std::size_t pixels = static_cast<std::size_t>(job.height) * job.width;
  const auto* columns = static_cast<const Between*>(job.columns);
  for (int y = first; y < last; ++y) {
    const std::size_t at = static_cast<std::size_t>(y) * job.width;
    const float* alpha = job.alpha + at;
    if (job.gradient != nullptr) std::memset(job.of_alpha + at, 0, sizeof(float) * job.width);
    for (int channel = 0; channel < job.channels; ++channel) {
      float* sky = scratch + job.coarse_width;
      enlarged_row(job, channel, y, columns, scratch, sky);
      if (job.gradient == nullptr) {
        const float* rgb = job.rgb + channel * pixels + at;
        float* out = job.out + channel * pixels + at;
        for (int x = 0; x < job.width; ++x) out[x] = rgb[x] + (1.0f - alpha[x]) * sky[x];
        continue;
      }
      const float* gradient = job.gradient + channel * pixels + at;
      float* of_alpha = job.of_alpha + at;
      float* sums = job.row_sums + (static_cast<std::size_t>(channel) * job.height + y) * job.coarse_width;
      std::memset(sums, 0, sizeof(float) * job.coarse_width);
      for (int x = 0; x < job.width; ++x) {
        of_alpha[x] -= gradient[x] * sky[x];
        const Between column = columns[x];
        const float shown = gradient[x] * (1.0f - alpha[x]), right = shown * column.share;
        sums[column.before] += shown - right;
        sums[column.after] += right;
      }
    }
  }
}

// Adds up the fine rows that a coarse one has a share in.
void gather_coarse_row(const OverJob& job, int channel, int row) {
  float* out = job.of_coarse + (static_cast<std::size_t>(channel) * job.coarse_height + row) * job.coarse_width;
  std::memset(out, 0, sizeof(float) * job.coarse_width);
  const float step = static_cast<float>(job.height) / static_cast<float>(job.coarse_height);
  const int first = larger(0, static_cast<int>((static_cast<float>(row) - 0.5f) * step) - 2);
  const int last = smaller(job.height, static_cast<int>((static_cast<float>(row) + 1.5f) * step) + 3);
  for (int y = row == 0 ? 0 : first; y < (row == job.coarse_height - 1 ? job.height : last); ++y) {
    const Between at = between(y, job.height, job.coarse_height);
    const float share = (at.before == row ? 1.0f - at.share : 0.0f) + (at.after == row ? at.share : 0.0f);
    if (share == 0.0f) continue;
    const float* sums = job.row_sums + (static_cast<std::size_t>(channel) * job.height + y) * job.coarse_width;
    for (int x = 0; x < job.coarse_width; ++x) out[x] += share * sums[x];
  }
}

void over(const OverJob& job) {
  auto* columns = static_cast<Between*>(job.columns);
  for (int x = 0; x < job.width; ++x) columns[x] = between(x, job.width, job.coarse_width);
  parallel_for(
      job.height, 16,
      [&](std::int64_t begin, std::int64_t end, int worker) {
        over_rows(job, static_cast<int>(begin), static_cast<int>(end), worker);
      },
      job.workers);
  if (job.gradient == nullptr) return;
  parallel_for(job.channels * job.coarse_height, 8, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t i = begin; i < end; ++i)
      gather_coarse_row(job, static_cast<int>(i / job.coarse_height), static_cast<int>(i % job.coarse_height));
  });
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
