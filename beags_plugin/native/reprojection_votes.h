// Labels of some views, voted by the lifted pixels of all (method, section 2; E5).
#pragma once

#include <cstdint>
#include <vector>

namespace beags {
namespace ops {

// A view that votes or is voted on: [height, width] images.
template <class T>
struct VotingView {
  int height, width;
  const T* depth;
  const int32_t* labels;        // null: no mask, or
  const uint8_t* short_labels;  // one of a byte a pixel, in which kShortIgnore does not vote; null: none
};

constexpr uint8_t kShortIgnore = 255;

template <class T>
struct VotedView {
  int view;           // index of the view whose pixels are voted on
  const T* maps;      // [views, 12]: A row-major, then b, from every view to this one (see CastJob)
  int32_t* labels;    // [height, width]; on entry the original labels, kept where there is no clear winner
  float* confidence;  // [height, width]
};

// Targets are shared among the threads, so each thread keeps one view's counters.
template <class T>
void reprojection_votes(const std::vector<VotingView<T>>& views, const std::vector<VotedView<T>>& targets,
                        int num_classes, double tau, int threads);

}  // namespace ops
}  // namespace beags
