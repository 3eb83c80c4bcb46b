// What the files that bind the module share: arrays as Python hands them over.
#pragma once

#include <nanobind/ndarray.h>

#include <cstdint>

namespace beags {

template <class T>
using Array = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu>;
using Ids = Array<const int32_t>;  // of classes

// The array's numbers, or null for None.
template <class T>
T* data(const Array<T>& array) {
  return array.is_valid() ? array.data() : nullptr;
}

}  // namespace beags
