// A growing array without initial values, for scratch memory that is reused from call to call.
#pragma once

#include <cstddef>
#include <new>

namespace mudg {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(); }

  // Makes room for `count` values, 64-byte aligned; what was inside is lost when it has to grow. False: no memory.
  bool reserve(std::size_t count) {
    if (count <= capacity_) return true;
    release();
    const std::size_t wanted = count + count / 8 + 64;
    data_ = static_cast<T*>(::operator new(wanted * sizeof(T), std::align_val_t{64}, std::nothrow));
    capacity_ = data_ == nullptr ? 0 : wanted;
    return data_ != nullptr;
  }

  T* data() const { return data_; }
  std::size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  void release() {
    ::operator delete(data_, std::align_val_t{64});
    data_ = nullptr;
    capacity_ = 0;
  }

  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace mudg
