#include "cpu.h"

#include <atomic>
#include <cstring>

#include "api.h"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace mudg {
namespace {

#if defined(__x86_64__)
// Read from the processor directly: __builtin_cpu_supports needs a run-time part that not every tool chain brings
// along.
struct X86Features {
  bool avx2 = false, avx512 = false;

  X86Features() {
    unsigned a = 0, b = 0, c = 0, d = 0;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return;
    const bool fma = (c >> 12) & 1u, saves_state = (c >> 27) & 1u;
    if (!fma || !saves_state || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return;
    unsigned state_low = 0, state_high = 0;  // which registers the operating system saves
    __asm__ volatile("xgetbv" : "=a"(state_low), "=d"(state_high) : "c"(0));
    const bool has_avx2 = ((b >> 5) & 1u) && ((b >> 3) & 1u) && ((b >> 8) & 1u);  // AVX2, BMI1, BMI2
    avx2 = has_avx2 && (state_low & 0x6u) == 0x6u;
    const bool has_avx512 =
        ((b >> 16) & 1u) && ((b >> 17) & 1u) && ((b >> 30) & 1u) && ((b >> 31) & 1u);  // F, DQ, BW, VL
    avx512 = avx2 && has_avx512 && (state_low & 0xe6u) == 0xe6u;
  }
};
#endif

constexpr const char* kNames[] = {"portable", "avx2", "avx512"};

Isa best_isa() {
  if (isa_available(Isa::kAvx512)) return Isa::kAvx512;
  if (isa_available(Isa::kAvx2)) return Isa::kAvx2;
  return Isa::kPortable;
}

std::atomic<Isa>& choice() {
  static std::atomic<Isa> chosen{best_isa()};
  return chosen;
}

}  // namespace

Isa isa() { return choice().load(std::memory_order_relaxed); }

bool isa_available(Isa wanted) {
#if defined(__x86_64__)
  static const X86Features features;
  if (wanted == Isa::kAvx512) return features.avx512;
  if (wanted == Isa::kAvx2) return features.avx2;
#endif
  return wanted == Isa::kPortable;
}

}  // namespace mudg

extern "C" {

MUDG_API const char* mudg_isa() { return mudg::kNames[static_cast<int>(mudg::isa())]; }

// Returns 0, or 1 when the name is unknown or cannot run here (the choice then stays). An empty name means the best.
MUDG_API int mudg_set_isa(const char* name) {
  if (name == nullptr || *name == '\0') {
    mudg::choice().store(mudg::best_isa());
    return 0;
  }
  for (int i = 0; i < 3; ++i) {
    const auto wanted = static_cast<mudg::Isa>(i);
    if (std::strcmp(name, mudg::kNames[i]) == 0 && mudg::isa_available(wanted)) {
      mudg::choice().store(wanted);
      return 0;
    }
  }
  return 1;
}

}  // extern "C"
