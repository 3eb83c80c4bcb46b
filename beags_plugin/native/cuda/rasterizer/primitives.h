// Sorts device memory and takes prefix sums. `temporary` is device memory of at least temporary_bytes().
#pragma once

#include "cuda/platform.h"

namespace beags {
namespace cuda {

// Returns the bytes that the functions below need for that many items.
size_t temporary_bytes(int64_t items);
// Sorts stably by bits first_bit .. end_bit - 1 of the keys.
void sort_pairs(void* temporary, size_t bytes, const uint32_t* keys, uint32_t* sorted_keys, const int32_t* values,
                int32_t* sorted_values, int64_t items, int first_bit, int end_bit, Stream stream);
// Replaces sums[i] by sums[0] + .. + sums[i - 1].
void exclusive_sum(void* temporary, size_t bytes, int64_t* sums, int64_t items, Stream stream);

}  // namespace cuda
}  // namespace beags
