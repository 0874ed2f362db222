// Parallel loops over a small thread pool of our own (no OpenMP run time).
//
// The caller always works too and returns as soon as every chunk is finished, whether or not a helper ever woke up,
// so a descheduled helper costs nothing. The pool is rebuilt in a forked child. A loop started inside a loop, or by
// several threads at once, is legal: it runs, with fewer helpers. Bodies must not throw.
#pragma once

#include <cstdint>

namespace mudg {

// Number of threads that parallel_for may use, the caller included. At least 1, at most kMaxThreads.
int thread_count();
void set_thread_count(int count);
constexpr int kMaxThreads = 64;

// Type-erased body: body(state, begin, end, worker).
using RangeBody = void (*)(const void* state, std::int64_t begin, std::int64_t end, int worker);
void parallel_ranges(std::int64_t count, std::int64_t grain, RangeBody body, const void* state, int max_workers);

// Calls body(begin, end, worker) for consecutive ranges of at most `grain` indices that cover [0, count) exactly once.
// Which worker gets which range varies between runs; worker is in [0, thread_count()). For results that do not depend
// on the thread count, let each range write its own output and reduce by range, not by worker. A loop with per-worker
// buffers passes their number as `max_workers`, since the thread setting may change at any time.
template <class Body>
inline void parallel_for(std::int64_t count, std::int64_t grain, const Body& body, int max_workers = kMaxThreads) {
  parallel_ranges(
      count, grain,
      [](const void* state, std::int64_t begin, std::int64_t end, int worker) {
        (*static_cast<const Body*>(state))(begin, end, worker);
      },
      &body, max_workers);
}

}  // namespace mudg
