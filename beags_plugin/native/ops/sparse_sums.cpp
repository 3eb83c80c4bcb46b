#include "ops/sparse_sums.h"

#include <algorithm>

namespace beags {
namespace ops {

template <class T>
void SparseSums::add(const int64_t* keys, const T* values, int64_t count) {
  merged_keys_.clear();
  merged_sums_.clear();
  merged_keys_.reserve(std::max(keys_.size(), static_cast<size_t>(count)));
  merged_sums_.reserve(merged_keys_.capacity());
  const auto append = [&](int64_t key, double sum) {
    merged_keys_.push_back(key);
    merged_sums_.push_back(sum);
  };
  size_t old = 0;
  for (int64_t fresh = 0; fresh < count; ++fresh) {
    for (; old < keys_.size() && keys_[old] < keys[fresh]; ++old) append(keys_[old], sums_[old]);
    double sum = values[fresh];
    if (old < keys_.size() && keys_[old] == keys[fresh]) sum += sums_[old++];
    append(keys[fresh], sum);
  }
  for (; old < keys_.size(); ++old) append(keys_[old], sums_[old]);
  keys_.swap(merged_keys_);
  sums_.swap(merged_sums_);
}

template void SparseSums::add(const int64_t*, const float*, int64_t);
template void SparseSums::add(const int64_t*, const double*, int64_t);

}  // namespace ops
}  // namespace beags
