#include "bodies/link_frames.h"

#include "bodies/templated_function.h"

namespace diffcloth::bodies {
namespace {

template <class T>
using RowMatrix4 = Eigen::Matrix<T, 4, 4, Eigen::RowMajor>;

template <class T>
RowMatrix4<T> frame_of(const Placed<T>& link) {
  RowMatrix4<T> F = RowMatrix4<T>::Identity();
  F.template topLeftCorner<3, 3>() = link.rotation;
  F.template topRightCorner<3, 1>() = link.origin;
  return F;
}

template <class T>
RowMatrix4<T> matrix_of(const Twist<T>& twist) {
  const Vector3<T>& w = twist.angular;
  RowMatrix4<T> S = RowMatrix4<T>::Zero();
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3;
    const int k = (i + 2) % 3;
    S(j, i) = w[k];
    S(i, j) = -w[k];
    S(i, 3) = twist.linear[i];
  }
  return S;
}

class LinkFrames final : public TemplatedFunction<LinkFrames> {
 public:
  explicit LinkFrames(const Tree& tree)
      : TemplatedFunction(
            {{"joints", {static_cast<std::size_t>(tree.joint_count)}}},
            {{"frames", {tree.links.size(), 4, 4}}, {"twists", {tree.links.size(), 4, 4}}}),
        tree_(tree) {}

  template <class T>
  void of(Inputs<T> in, Outputs<T> out) const {
    std::vector<Placed<T>> placed(tree_.links.size());
    for (const Index l : tree_.order) {
      const Link& link = tree_.links[l];
      if (link.parent < 0) {
        placed[l] = {.rotation = Matrix3<T>::Identity(), .origin = Vector3<T>::Zero(), .joint = {}};
      } else {
        const T coordinate = link.moves() ? in[0][link.coordinate] : T(0.0);
        placed[l] = place_on<T>(placed[link.parent], link, coordinate);
      }
      put<T>(frame_of(placed[l]), out[0] + 16 * l);
      put<T>(matrix_of(placed[l].joint), out[1] + 16 * l);
    }
  }

 private:
  Tree tree_;
};

}  // namespace

std::unique_ptr<SmoothFunction> link_frames(const Tree& tree) {
  return std::make_unique<LinkFrames>(tree);
}

}  // namespace diffcloth::bodies
