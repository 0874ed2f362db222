// Which instruction set the kernels run with: chosen from the processor, or asked for by name.
#pragma once

namespace mudg {

enum class Isa { kPortable = 0, kAvx2 = 1, kAvx512 = 2 };

// The choice in force. Kernels read it once per call.
Isa isa();

// Whether this processor can run it (and this build contains it).
bool isa_available(Isa wanted);

}  // namespace mudg
