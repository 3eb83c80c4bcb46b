// Holds one view of one set of Gaussians: projected and binned once, then rendered, differentiated or queried.
#pragma once

#include <vector>

#include "rasterizer/binning.h"
#include "rasterizer/gaussian_inputs.h"
#include "rasterizer/projection.h"
#include "rasterizer/scratch.h"
#include "rasterizer/types.h"

namespace beags {

// Below about 0.3 ms of work, a team of threads costs more than it saves.
constexpr int64_t kTeamGaussians = 2000;  // projecting one takes a tenth of a microsecond
constexpr int64_t kTeamPairs = 500;       // rendering one takes most of a microsecond

// Null: not wanted. The others are zero on entry, because Gaussians that were not rendered are not written.
template <class T>
struct InputGradients {
  T *means, *quats, *log_scales, *opacity_logits, *colors, *screen_shift, *background;
};

// The amount of work; see Work.
struct WorkCounts {
  int64_t lanes, contributing;
  int64_t tile_pairs;  // (tile, Gaussian) pairs of these kernels' bounds
  int64_t box_pairs;   // pairs of the usual bounds, boxes of 3.33 standard deviations
};

// The sums or pixel counts by Gaussian and class that are not zero: key = Gaussian * num_classes + class, ascending.
template <class T>
struct Contributions {
  std::vector<int64_t> keys;
  std::vector<T> values;
};

template <class T>
bool wants_geometry(const InputGradients<T>& to) {
  return to.means || to.quats || to.log_scales || to.opacity_logits || to.screen_shift;
}

template <class T>
class Frame {
 public:
  // visible: [N], set to whether a Gaussian is rendered and its box touches the image.
  Frame(const View& view, const Inputs<T>& inputs, bool* visible, int threads);

  int64_t num_nonfinite() const { return num_nonfinite_; }
  int64_t num_pairs() const { return bins_.tile_start.back(); }
  int64_t num_gaussians() const { return num_gaussians_; }
  const View& view() const { return view_; }

  // Renders. background: [3]; target: [height, width] or null. keep: for a later `backward`.
  void forward(const Images<T>& images, const T* background, const int32_t* target, bool keep, int threads);
  // Computes the gradients, once after `forward`, with the same inputs and target.
  void backward(const Inputs<T>& inputs, const int32_t* target, const Images<const T>& from,
                const InputGradients<T>& to, int threads) const;

  // Sums w by Gaussian and label. labels: [height, width]; out: [N, num_classes], zero on entry. Labels outside 0 ..
  // num_classes - 1 do not count.
  void class_contributions(const int32_t* labels, int num_classes, T* out, int threads) const;
  // Returns the same sums as a list, whose size does not depend on the number of classes.
  Contributions<T> sparse_class_contributions(const int32_t* labels, int num_classes, int threads) const;
  // Counts pixels with w > min_weight instead of summing w; exact up to 2^24.
  Contributions<T> sparse_class_pixel_counts(const int32_t* labels, int num_classes, T min_weight, int threads) const;
  // Sums only the `most` largest w of each pixel (the nearer of equals) among its first `within` hits.
  Contributions<T> sparse_top_contributions(const int32_t* labels, int num_classes, int most, int within,
                                            int threads) const;
  // Finds each pixel's class. classes, share: [height, width]. Class ids lie in 0 .. num_classes - 1.
  void class_map(int num_classes, int32_t* classes, T* share, int threads) const;
  // Renders the sums of w by class, [height, width, num_classes], zero on entry. keep: for its backward.
  void class_channels(int num_classes, T* channels, bool keep, int threads);
  // Computes their gradients, once after `class_channels`, with the same inputs; colours and background have none.
  void class_channels_backward(const Inputs<T>& inputs, int num_classes, const T* gradient, const InputGradients<T>& to,
                               int threads) const;
  // Renders channels of features, sum of w f. features: [N, count], count a multiple of 4; channels: [height, width,
  // count]. keep: for its backward.
  void feature_channels(const T* features, int count, T* channels, bool keep, int threads);
  // Computes their gradients, once after `feature_channels`, with the same inputs and features. g_features: [N, count]
  // or null; without gradients of the geometry in `to`, they cost less.
  void feature_channels_backward(const Inputs<T>& inputs, const T* features, int count, const T* gradient,
                                 const InputGradients<T>& to, T* g_features, int threads) const;
  void dominant_gaussian(int32_t* indices, int threads) const;
  WorkCounts work_counts(int threads) const;

 private:
  // The sum of each record for each label that its tile holds.
  struct LabelSums {
    std::vector<std::vector<int32_t>> tile_labels;
    std::vector<T> sums;
    std::vector<int64_t> row_of;   // [records], where the sums of a record start, in the order of its tile's labels
    std::vector<int32_t> tile_of;  // [records]
  };
  // query: the kernel's inputs besides labels and sums.
  LabelSums label_sums(const int32_t* labels, int num_classes, void (*kernel)(const Job<T>&, const Query<T>&, int),
                       Query<T> query, int threads) const;
  Contributions<T> sparse(const LabelSums& found, int num_classes, int threads) const;
  // Calls work(query, tile) for every tile; the query numbers the classes of its Gaussians and has zeros to sum into.
  template <class Work>
  void for_each_tile_of_classes(int num_classes, int threads, Work work) const;
  // Makes memory for what the backward needs.
  void make_saved(bool keep, bool geometry, bool distortion);
  Job<T> job() const;
  int tiles() const { return tiles_x_ * tiles_y_; }
  // Calls work(tile) for every tile; idle threads take the next one.
  template <class Work>
  void for_each_tile(int threads, Work work) const {
    const int team = num_pairs() < kTeamPairs ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(dynamic, 1)
    for (int tile = 0; tile < tiles(); ++tile) work(tile);
  }
  // Calls kernel(job, tile) for every tile, with memory for its channels.
  void run_features(Job<T> job, const T* features, int count, void (*kernel)(const Job<T>&, int), int threads) const;
  void reduce(const Inputs<T>& inputs, const T* records, int size, const InputGradients<T>& to, int threads) const;

  View view_;
  int tiles_x_, tiles_y_;
  int64_t num_gaussians_, num_nonfinite_ = 0;
  Scratch<Splat<T>> splats_;
  Bins bins_;
  T background_[3] = {};
  Scratch<T> kept_;  // memory of `saved_`
  Saved<T> saved_ = {};
};

}  // namespace beags
