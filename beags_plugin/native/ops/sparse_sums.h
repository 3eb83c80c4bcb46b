// Sums values for the keys that occur.
#pragma once

#include <cstdint>
#include <vector>

namespace beags {
namespace ops {

class SparseSums {
 public:
  // Adds values. keys: [count], ascending, each once. A key's values are added in the order of the calls.
  template <class T>
  void add(const int64_t* keys, const T* values, int64_t count);
  const std::vector<int64_t>& keys() const { return keys_; }  // ascending
  const std::vector<double>& sums() const { return sums_; }

 private:
  std::vector<int64_t> keys_, merged_keys_;
  std::vector<double> sums_, merged_sums_;
};

}  // namespace ops
}  // namespace beags
