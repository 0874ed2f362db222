// A growing array without initial values, for scratch memory that is reused from call to call.
#pragma once

#include <cstddef>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace mudg {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(); }

  // From this size on a buffer asks for huge pages: the rasteriser reads it at random places, and with small pages
  // address translation costs as much as the memory itself.
  static constexpr std::size_t kHugePage = std::size_t{1} << 21;

  // Makes room for `count` values, 64-byte aligned; what was inside is lost when it has to grow. False: no memory.
  bool reserve(std::size_t count) {
    if (count <= capacity_) return true;
    release();
    const std::size_t wanted = count + count / 8 + 64;
    const std::size_t bytes = wanted * sizeof(T);
    const std::align_val_t alignment{bytes < kHugePage ? std::size_t{64} : kHugePage};
    data_ = static_cast<T*>(::operator new(bytes, alignment, std::nothrow));
    if (data_ == nullptr) return false;
    capacity_ = wanted;
    alignment_ = alignment;
#if defined(__linux__)
    // A wish: refusal does no harm.
    if (bytes >= kHugePage) madvise(data_, bytes / kHugePage * kHugePage, MADV_HUGEPAGE);
#endif
    return true;
  }

  T* data() const { return data_; }
  std::size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  void release() {
    ::operator delete(data_, alignment_);
    data_ = nullptr;
    capacity_ = 0;
  }

  T* data_ = nullptr;
  std::size_t capacity_ = 0;
  std::align_val_t alignment_{64};
};

}  // namespace mudg
