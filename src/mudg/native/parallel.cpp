#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <thread>

#if defined(_WIN32)
#include <process.h>
#else
#include <unistd.h>
#endif

#include "api.h"

namespace mudg {
namespace {

int current_process() {
#if defined(_WIN32)
  return _getpid();
#else
  return static_cast<int>(getpid());
#endif
}

void spin_pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__) || defined(__arm__)
  __asm__ __volatile__("yield" ::: "memory");
#endif
}

// One parallel loop. Shared ownership: a helper that wakes late still finds a live object, sees that nothing is left
// and never touches the caller's stack.
struct Job {
  RangeBody body;
  const void* state;
  std::int64_t count;
  std::int64_t grain;
  int workers;
  std::atomic<std::int64_t> next{0};
  std::atomic<std::int64_t> finished{0};
  std::atomic<int> joined{1};  // worker 0 is the caller

  void work(int worker) {
    for (;;) {
      const std::int64_t begin = next.fetch_add(grain, std::memory_order_relaxed);
      if (begin >= count) return;
      const std::int64_t end = std::min(begin + grain, count);
      body(state, begin, end, worker);
      finished.fetch_add(end - begin, std::memory_order_release);
    }
  }
};

thread_local bool inside_loop = false;

class Pool {
 public:
  explicit Pool(int process) : process_(process) {}

  int process() const { return process_; }

  void run(const std::shared_ptr<Job>& job) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      while (helpers_ < job->workers - 1 && start_helper()) ++helpers_;
      job_ = job;
      ++generation_;
    }
    if (job->workers == 2 && helpers_ == 1) {
      wake_.notify_one();
    } else {
      wake_.notify_all();
    }
    inside_loop = true;
    job->work(0);
    inside_loop = false;
    for (int turn = 0; job->finished.load(std::memory_order_acquire) < job->count; ++turn) {
      if (turn < 200) {
        spin_pause();
      } else {
        std::this_thread::yield();
      }
    }
  }

 private:
  bool start_helper() {
    try {
      std::thread([this] { serve(); }).detach();
      return true;
    } catch (const std::system_error&) {
      return false;  // the system refuses more threads: go on with those there are
    }
  }

  void serve() {
    inside_loop = true;
    std::uint64_t seen = 0;
    for (;;) {
      std::shared_ptr<Job> job;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return generation_ != seen; });
        seen = generation_;
        job = job_;
      }
      const int worker = job->joined.fetch_add(1);
      if (worker < job->workers) job->work(worker);
    }
  }

  const int process_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::shared_ptr<Job> job_;
  std::uint64_t generation_ = 0;
  int helpers_ = 0;
};

// The pool lives as long as the process: its threads may be waiting in it at exit. A forked child inherits the object
// but not the threads, so it leaves the old one alone and makes its own.
Pool& pool() {
  static std::atomic<Pool*> shared{nullptr};
  const int process = current_process();
  Pool* found = shared.load(std::memory_order_acquire);
  while (found == nullptr || found->process() != process) {
    Pool* fresh = new Pool(process);
    if (shared.compare_exchange_strong(found, fresh, std::memory_order_acq_rel)) return *fresh;
    delete fresh;  // no thread was started on it yet
  }
  return *found;
}

std::atomic<int>& thread_setting() {
  static std::atomic<int> count{std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, kMaxThreads)};
  return count;
}

}  // namespace

int thread_count() { return thread_setting().load(std::memory_order_relaxed); }

void set_thread_count(int count) { thread_setting().store(std::clamp(count, 1, kMaxThreads)); }

void parallel_ranges(std::int64_t count, std::int64_t grain, RangeBody body, const void* state, int max_workers) {
  if (count <= 0) return;
  const std::int64_t step = std::max<std::int64_t>(grain, 1);
  const std::int64_t chunks = (count + step - 1) / step;
  const int workers = static_cast<int>(std::min<std::int64_t>(std::min(thread_count(), max_workers), chunks));
  if (workers <= 1 || inside_loop) {
    for (std::int64_t begin = 0; begin < count; begin += step) body(state, begin, std::min(begin + step, count), 0);
    return;
  }
  auto job = std::make_shared<Job>();
  job->body = body;
  job->state = state;
  job->count = count;
  job->grain = step;
  job->workers = workers;
  pool().run(job);
}

}  // namespace mudg

extern "C" {

MUDG_API int mudg_abi_version() { return MUDG_ABI_VERSION; }

MUDG_API void mudg_set_threads(int count) { mudg::set_thread_count(count); }

MUDG_API int mudg_threads() { return mudg::thread_count(); }

// Sums 0 .. count-1 in parallel; lets a test see that the pool covers a range exactly once.
MUDG_API std::int64_t mudg_parallel_sum(std::int64_t count, std::int64_t grain) {
  std::atomic<std::int64_t> total{0};
  mudg::parallel_for(count, grain, [&](std::int64_t begin, std::int64_t end, int) {
    std::int64_t part = 0;
    for (std::int64_t i = begin; i < end; ++i) part += i;
    total.fetch_add(part);
  });
  return total.load();
}

}  // extern "C"
