// Weighted cross entropy of class logits per pixel, and its gradient, in one sweep.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Sixteen pixels, of which the first `count` exist. Returns the sum of weight * cross entropy.
MUDG_INLINE float class_loss_lanes(const ClassLossJob& job, std::int64_t at, int count) {
  constexpr float kLog2E = 1.44269504088896341f, kLn2 = 0.693147180559945309f;
  alignas(64) float wanted[kLanes], weights[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const std::int64_t target = lane < count ? job.target[at + lane] : -1;
    const bool labelled = target >= 0 && target < job.classes;
    wanted[lane] = labelled ? static_cast<float>(target) : -1.0f;
    weights[lane] = labelled ? job.weight[at + lane] : 0.0f;
  }
  const Floats target = load(wanted), weight = load(weights), one = splat(1.0f), half = splat(0.5f);
  const auto logit = [&](int channel) {
    const Floats value = load_first(job.logits + channel * job.pixels + at, count);
    return channel == job.raised ? value + load_first(job.lift + at, count) : value;
  };
  const auto is_target = [&](int channel) {
    return abs_of(target - splat(static_cast<float>(channel))) < half;
  };
  Floats largest = logit(0), picked = splat(0.0f), total = splat(0.0f),
         poison = splat(0.0f);
  for (int channel = 1; channel < job.classes; ++channel) largest = max_of(logit(channel), largest);
  for (int channel = 0; channel < job.classes; channel += kGroup) {
    Floats exponent[kGroup], power[kGroup];
    for (int k = 0; k < kGroup; ++k) {
      exponent[k] = splat(0.0f);
      if (channel + k >= job.classes) continue;
      const Floats value = logit(channel + k);
      exponent[k] = max_of((value - largest) * splat(kLog2E), splat(-126.0f));
      picked = select(is_target(channel + k), value, picked);
      poison = mul_add(value, splat(0.0f), poison);  // NaN where a logit is not finite: exponential and logarithm hide it
    }
    exp2_group(exponent, power);
    for (int k = 0; k < kGroup && channel + k < job.classes; ++k) {
      total = total + power[k];
      store_first(job.gradient + (channel + k) * job.pixels + at, count, power[k]);
    }
  }
  const Floats share = weight * splat(job.scale), inverse = one / total;
  for (int channel = 0; channel < job.classes; ++channel) {
    float* gradient = job.gradient + channel * job.pixels + at;
    const Floats probability = load_first(gradient, count) * inverse;
    store_first(gradient, count, share * (probability - keep(is_target(channel), one)));
  }
  return sum(mul_add(weight, mul_add(log2_of(total), splat(kLn2), largest) - picked, poison));
}

double class_loss(const ClassLossJob& job) {
  const std::int64_t pieces = (job.pixels + kClassLossPiece - 1) / kClassLossPiece;
  parallel_for(pieces, 1, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t piece = begin; piece < end; ++piece) {
      const std::int64_t first = piece * kClassLossPiece, last = smaller(job.pixels, first + kClassLossPiece);
      double total = 0.0;
      for (std::int64_t at = first; at < last; at += kLanes)
        total += class_loss_lanes(job, at, static_cast<int>(smaller<std::int64_t>(kLanes, last - at)));
      job.partial[piece] = total;
    }
  });
  double total = 0.0;  // in a fixed order: the same value for any number of threads
  for (std::int64_t piece = 0; piece < pieces; ++piece) total += job.partial[piece];
  return total * static_cast<double>(job.scale);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
