#include "kernels_impl.h"

namespace mudg {

const Kernels& kernels_avx512() { return isa_avx512::kTable; }

}  // namespace mudg
