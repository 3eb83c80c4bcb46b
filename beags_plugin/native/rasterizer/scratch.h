// Reuses the memory of one render for the next: new pages from the system cost a tenth of a render, and more on several
// threads.
#pragma once

#include <cstddef>
#include <type_traits>
#include <utility>

namespace beags {

// Returns a block of at least `bytes`, aligned to cache lines; `bytes` becomes its size. Throws std::bad_alloc.
void* take_scratch(size_t& bytes);
// Takes a block back. At most 128 MiB of unused blocks are kept.
void give_scratch(void* block, size_t bytes);

// `count` numbers or plain structures, uninitialised.
template <class Element>
class Scratch {
  static_assert(std::is_trivially_destructible_v<Element>, "nothing is destroyed");

 public:
  Scratch() = default;
  explicit Scratch(size_t count) : bytes_(count * sizeof(Element)) {
    elements_ = static_cast<Element*>(take_scratch(bytes_));
  }
  Scratch(Scratch&& other) noexcept { swap(other); }
  Scratch& operator=(Scratch&& other) noexcept {
    swap(other);
    return *this;
  }
  ~Scratch() {
    if (elements_) give_scratch(elements_, bytes_);
  }

  Element* get() const { return elements_; }
  Element& operator[](size_t i) const { return elements_[i]; }

 private:
  void swap(Scratch& other) {
    std::swap(elements_, other.elements_);
    std::swap(bytes_, other.bytes_);
  }

  Element* elements_ = nullptr;
  size_t bytes_ = 0;
};

}  // namespace beags
