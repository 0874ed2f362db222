#include "kernels_impl.h"

namespace mudg {

const Kernels& kernels_avx2() { return isa_avx2::kTable; }

}  // namespace mudg
