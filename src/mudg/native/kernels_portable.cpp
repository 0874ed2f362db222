#include "kernels_impl.h"

namespace mudg {

const Kernels& kernels_portable() { return isa_portable::kTable; }

}  // namespace mudg
