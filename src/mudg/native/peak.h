// What this processor can do at best with sixteen lanes: the ceiling in the roofline of the benchmark.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace mudg::MUDG_ISA_NAMESPACE {
namespace {

// Independent multiply-adds in registers, `rounds` times. Returns how many floating-point operations that were; `sink`
// receives a value that depends on all of them.
double peak_multiply_add(std::int64_t rounds, float* sink) {
  constexpr int kChains = 12;
  Floats chain[kChains];
  for (int k = 0; k < kChains; ++k) chain[k] = splat(1.0f + 0.01f * static_cast<float>(k));
  const Floats factor = splat(*sink), addend = splat(1.0f - *sink);
  for (std::int64_t round = 0; round < rounds; ++round) {
    for (int k = 0; k < kChains; ++k) chain[k] = mul_add(chain[k], factor, addend);
  }
  for (int k = 1; k < kChains; ++k) chain[0] = chain[0] + chain[k];
  *sink = sum(chain[0]);
  return 2.0 * kLanes * kChains * static_cast<double>(rounds);
}

}  // namespace
}  // namespace mudg::MUDG_ISA_NAMESPACE
