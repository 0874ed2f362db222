// Weighted cross entropy of class logits per pixel, and its gradient, in one sweep.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// A block of pixels, of which the first `count` exist, is copied to `scratch` [classes][kClassLossBlock] and worked on
// there: planes are often a whole number of pages apart, and then push each other out of the cache. Returns the sum of
// weight * cross entropy.
MUDG_INLINE float class_loss_block(const ClassLossJob& job, std::int64_t at, int count, float* scratch) {
  constexpr int kBlock = kClassLossBlock, kVectors = kBlock / kLanes;
  static_assert(kVectors % kGroup == 0, "a block is a whole number of groups");
  constexpr float kLog2E = 1.44269504088896341f, kLn2 = 0.693147180559945309f;
  alignas(64) float wanted[kBlock], weights[kBlock], lift[kBlock] = {};
  const std::size_t bytes = sizeof(float) * static_cast<std::size_t>(count);
  for (int i = 0; i < kBlock; ++i) {
    const std::int64_t target = i < count ? job.target[at + i] : -1;
    const bool labelled = target >= 0 && target < job.classes;
    wanted[i] = labelled ? static_cast<float>(target) : -1.0f;
    weights[i] = labelled ? job.weight[at + i] : 0.0f;
  }
  if (job.raised >= 0) std::memcpy(lift, job.lift + at, bytes);

  Floats largest[kVectors], picked[kVectors], total[kVectors];
  Floats poison = splat(0.0f);  // NaN where a logit is not finite: exponential and logarithm hide it
  for (int channel = 0; channel < job.classes; ++channel) {
    float* row = scratch + channel * kBlock;
    if (count < kBlock) std::memset(row, 0, sizeof(float) * kBlock);
    std::memcpy(row, job.logits + channel * job.pixels + at, bytes);
    const Floats here = splat(static_cast<float>(channel)), half = splat(0.5f);
    for (int v = 0; v < kVectors; ++v) {
      Floats value = load(row + v * kLanes);
      if (channel == job.raised) {
        value = value + load(lift + v * kLanes);
        store(row + v * kLanes, value);
      }
      poison = mul_add(value, splat(0.0f), poison);
      largest[v] = channel == 0 ? value : max_of(value, largest[v]);
      const Mask is_target = abs_of(load(wanted + v * kLanes) - here) < half;
      picked[v] = select(is_target, value, channel == 0 ? splat(0.0f) : picked[v]);
    }
  }
  for (int v = 0; v < kVectors; ++v) total[v] = splat(0.0f);
  for (int channel = 0; channel < job.classes; ++channel) {
    float* row = scratch + channel * kBlock;
    for (int v = 0; v < kVectors; v += kGroup) {
      Floats exponent[kGroup], power[kGroup];
      for (int k = 0; k < kGroup; ++k)
        exponent[k] = max_of((load(row + (v + k) * kLanes) - largest[v + k]) * splat(kLog2E), splat(-126.0f));
      exp2_group(exponent, power);
      for (int k = 0; k < kGroup; ++k) {
        total[v + k] = total[v + k] + power[k];
        store(row + (v + k) * kLanes, power[k]);
      }
    }
  }
  Floats loss = poison, share[kVectors], inverse[kVectors];
  for (int v = 0; v < kVectors; ++v) {
    const Floats weight = load(weights + v * kLanes);
    loss = mul_add(weight, mul_add(log2_of(total[v]), splat(kLn2), largest[v]) - picked[v], loss);
    share[v] = weight * splat(job.scale);
    inverse[v] = splat(1.0f) / total[v];
  }
  for (int channel = 0; channel < job.classes; ++channel) {
    float* row = scratch + channel * kBlock;
    const Floats here = splat(static_cast<float>(channel)), half = splat(0.5f);
    for (int v = 0; v < kVectors; ++v) {
      const Mask is_target = abs_of(load(wanted + v * kLanes) - here) < half;
      const Floats probability = load(row + v * kLanes) * inverse[v];
      store(row + v * kLanes, share[v] * (probability - keep(is_target, splat(1.0f))));
    }
    std::memcpy(job.gradient + channel * job.pixels + at, row, bytes);
  }
  return sum(loss);
}

double class_loss(const ClassLossJob& job) {
  const std::int64_t pieces = (job.pixels + kClassLossPiece - 1) / kClassLossPiece;
  const std::size_t stride = static_cast<std::size_t>(job.classes) * kClassLossBlock;
  parallel_for(
      pieces, 1,
      [&](std::int64_t begin, std::int64_t end, int worker) {
        float* scratch = job.worker_scratch + static_cast<std::size_t>(worker) * stride;
        for (std::int64_t piece = begin; piece < end; ++piece) {
          const std::int64_t first = piece * kClassLossPiece, last = smaller(job.pixels, first + kClassLossPiece);
          double total = 0.0;
          for (std::int64_t at = first; at < last; at += kClassLossBlock)
            total += class_loss_block(job, at, static_cast<int>(smaller<std::int64_t>(kClassLossBlock, last - at)), scratch);
          job.partial[piece] = total;
        }
      },
      job.workers);
  double total = 0.0;  // in a fixed order: the same value for any number of threads
  for (std::int64_t piece = 0; piece < pieces; ++piece) total += job.partial[piece];
  return total * static_cast<double>(job.scale);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
