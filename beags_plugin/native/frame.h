// One view of one set of surfels: projected and binned once, then drawn, differentiated or asked for its products.
#pragma once

#include <memory>
#include <vector>

#include "binning.h"
#include "projection.h"
#include "types.h"

namespace beags {

// N surfels, contiguous, as rasterizers/interface.py's SurfelInputs; class_ids may be null.
template <class T>
struct Inputs {
  int64_t count;
  const T *means, *quats, *log_scales, *opacity_logits, *colors;
  const int32_t* class_ids;
};

// Null: not wanted.
template <class T>
struct Images {
  T *color, *alpha, *depth, *median_depth, *normal, *distortion, *boundary;
};

template <class T>
struct ImageGradients {
  const T *color, *alpha, *depth, *median_depth, *normal, *distortion, *boundary;
};

// Zero on entry: surfels that were not drawn are left alone.
template <class T>
struct InputGradients {
  T *means, *quats, *log_scales, *opacity_logits, *colors, *background;
};

// "avx2" or "baseline": the kernels in use. The environment variable BEAGS_ISA=baseline forces the plain ones.
const char* instruction_set();

template <class T>
class Frame {
 public:
  // visible: [N], set to whether a surfel was drawn and its box touches the image.
  Frame(const View& view, const Inputs<T>& inputs, bool* visible, int threads);

  int64_t num_nonfinite() const { return num_nonfinite_; }
  int64_t num_pairs() const { return static_cast<int64_t>(bins_.pairs.size()); }
  int64_t num_surfels() const { return num_surfels_; }
  const View& view() const { return view_; }

  // Keeps what `backward` needs. background: [3]; target: [height, width] or null.
  void forward(const Images<T>& images, const T* background, const int32_t* target, int threads);
  // Once after `forward`, with the same inputs and target.
  void backward(const Inputs<T>& inputs, const int32_t* target, const ImageGradients<T>& from,
                const InputGradients<T>& to, int threads);

  // labels: [height, width]; out: [N, num_classes], zero on entry; labels outside 0 .. num_classes - 1 do not count.
  void class_contributions(const int32_t* labels, int num_classes, T* out, int threads) const;
  // classes, share: [height, width]. Class ids lie in 0 .. num_classes - 1.
  void class_map(int num_classes, int32_t* classes, T* share, int threads) const;
  void heaviest(int32_t* indices, int threads) const;

 private:
  Job<T> job() const;
  int tiles() const { return tiles_x_ * tiles_y_; }

  View view_;
  int tiles_x_, tiles_y_;
  int64_t num_surfels_, num_nonfinite_ = 0;
  std::unique_ptr<Splat<T>[]> splats_;
  Bins bins_;
  // Saved for the backward, [tiles, 256].
  bool geometry_ = false, distortion_ = false;
  T background_[3] = {};
  std::vector<T> end_transmittance_, depth_sum_, first_inverse_depth_, moment1_, moment2_;
  std::vector<int32_t> last_, median_pair_;
};

}  // namespace beags
