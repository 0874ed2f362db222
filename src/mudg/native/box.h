// Means over squares of pixels, what lies beyond the border left out, and the transposed map that a gradient needs.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// One over how many of the places at - radius .. at + radius lie in 0 .. count - 1.
MUDG_INLINE float share_of(int at, int count, int radius) {
  return 1.0f / static_cast<float>(smaller(count - 1, at + radius) - larger(0, at - radius) + 1);
}

// A row: the rows around it added up into a line with `radius` zeros on either side, and that line added up along itself. The mean
// divides after adding, its transpose before.
void box_row(const BoxJob& job, const float* plane, int y, float* line, float* out) {
  const int first = larger(0, y - job.radius), last = smaller(job.height - 1, y + job.radius);
  std::memset(line, 0, sizeof(float) * (job.width + 2 * job.radius));
  float* inside = line + job.radius;
  for (int row = first; row <= last; ++row) {
    const float* x = plane + static_cast<std::size_t>(row) * job.width;
    const float share = job.transposed ? share_of(row, job.height, job.radius) : 1.0f;
    for (int i = 0; i < job.width; ++i) inside[i] += share * x[i];
  }
  if (job.transposed)
    for (int i = 0; i < job.width; ++i) inside[i] *= share_of(i, job.width, job.radius);
  std::memset(out, 0, sizeof(float) * job.width);
  for (int k = 0; k <= 2 * job.radius; ++k)
    for (int i = 0; i < job.width; ++i) out[i] += line[k + i];
  if (job.transposed) return;
  const float share = share_of(y, job.height, job.radius);
  for (int i = 0; i < job.width; ++i) out[i] *= share * share_of(i, job.width, job.radius);
}

void box_mean(const BoxJob& job) {
  const std::size_t pixels = static_cast<std::size_t>(job.height) * job.width;
  parallel_for(
      static_cast<std::int64_t>(job.planes) * job.height, 16,
      [&](std::int64_t begin, std::int64_t end, int worker) {
        float* line = job.worker_scratch + static_cast<std::size_t>(worker) * (job.width + 2 * job.radius);
        for (std::int64_t i = begin; i < end; ++i)
          box_row(job, job.x + i / job.height * pixels, static_cast<int>(i % job.height), line, job.out + i * job.width);
      },
      job.workers);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
