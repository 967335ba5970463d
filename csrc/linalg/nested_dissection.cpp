#include "linalg/nested_dissection.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numbers>
#include <utility>

#include <Eigen/Eigenvalues>

#include "linalg/ordering.h"

namespace diffcloth::linalg {
namespace {

/// Largest part that is ordered by minimum degree, which is as good at this size.
constexpr Index kSmallPart = 400;
/// Number of landmarks: nodes far from each other; the distances from them locate a node.
constexpr int kLandmarks = 4;
/// Number of averaging sweeps that smooth coordinates from integer distances.
constexpr int kSmoothings = 8;
/// Number of directions in which a part may be cut.
constexpr int kDirections = 8;

using Coordinates = std::vector<Eigen::Vector2d>;

/// Subgraph of the given nodes, numbered in their order. `number` is scratch, -1 everywhere.
Graph induced(const Graph& graph, const std::vector<Index>& nodes, std::vector<Index>& number) {
  Graph part;
  for (std::size_t k = 0; k < nodes.size(); ++k) number[nodes[k]] = static_cast<Index>(k);
  part.start.push_back(0);
  for (const Index node : nodes) {
    for (Index e = graph.start[node]; e < graph.start[node + 1]; ++e) {
      if (number[graph.neighbor[e]] >= 0) part.neighbor.push_back(number[graph.neighbor[e]]);
    }
    part.start.push_back(static_cast<Index>(part.neighbor.size()));
  }
  part.vertex = nodes;
  for (const Index node : nodes) number[node] = -1;
  return part;
}

/// Number of edges from a node to every other, -1 if there is no path.
std::vector<Index> distances(const Graph& part, Index from) {
  std::vector<Index> distance(part.size(), -1);
  std::vector<Index> queue{from};
  distance[from] = 0;
  for (std::size_t head = 0; head < queue.size(); ++head) {
    const Index node = queue[head];
    for (Index e = part.start[node]; e < part.start[node + 1]; ++e) {
      const Index next = part.neighbor[e];
      if (distance[next] >= 0) continue;
      distance[next] = distance[node] + 1;
      queue.push_back(next);
    }
  }
  return distance;
}

/// Two coordinates of each node of a connected part: the principal components of its distances from
/// landmarks, each of which is as far as possible from the earlier ones.
Coordinates embed(const Graph& part) {
  using Vector = Eigen::Matrix<double, kLandmarks, 1>;
  const Index n = part.size();
  const auto farthest = [](const std::vector<Index>& distance) {
    return static_cast<Index>(std::ranges::max_element(distance) - distance.begin());
  };
  std::vector<Vector> position(n);
  std::vector<Index> nearest(n, std::numeric_limits<Index>::max());
  Index landmark = farthest(distances(part, 0));
  Vector mean = Vector::Zero();
  for (int l = 0; l < kLandmarks; ++l) {
    const std::vector<Index> distance = distances(part, landmark);
    for (Index i = 0; i < n; ++i) {
      position[i][l] = distance[i];
      mean[l] += distance[i];
      nearest[i] = std::min(nearest[i], distance[i]);
    }
    landmark = farthest(nearest);
  }
  mean /= n;
  Eigen::Matrix<double, kLandmarks, kLandmarks> covariance;
  covariance.setZero();
  for (const Vector& p : position) covariance += (p - mean) * (p - mean).transpose();
  const Eigen::SelfAdjointEigenSolver<decltype(covariance)> eigen(covariance);
  Coordinates result(n);
  for (Index i = 0; i < n; ++i) {
    result[i] = eigen.eigenvectors().rightCols<2>().transpose() * (position[i] - mean);
  }
  return result;
}

void smooth(const Graph& part, Coordinates& x) {
  Coordinates next(x.size());
  for (int sweep = 0; sweep < kSmoothings; ++sweep) {
    for (Index i = 0; i < part.size(); ++i) {
      Eigen::Vector2d sum = x[i];
      for (Index e = part.start[i]; e < part.start[i + 1]; ++e) sum += x[part.neighbor[e]];
      next[i] = sum / (part.start[i + 1] - part.start[i] + 1);
    }
    x.swap(next);
  }
}

/// Half of each node after a cut across a direction.
std::vector<char> halves(const Coordinates& x, const Eigen::Vector2d& direction) {
  std::vector<std::pair<double, Index>> along(x.size());
  for (std::size_t i = 0; i < x.size(); ++i) {
    along[i] = {x[i].dot(direction), static_cast<Index>(i)};
  }
  const auto middle = along.begin() + static_cast<std::ptrdiff_t>(along.size() / 2);
  std::nth_element(along.begin(), middle, along.end());
  std::vector<char> half(x.size(), 1);
  for (auto it = along.begin(); it != middle; ++it) half[it->second] = 0;
  return half;
}

/// Nodes of each half that have neighbors in the other.
std::array<std::vector<Index>, 2> boundaries(const Graph& part, const std::vector<char>& half) {
  std::array<std::vector<Index>, 2> result;
  for (Index i = 0; i < part.size(); ++i) {
    for (Index e = part.start[i]; e < part.start[i + 1]; ++e) {
      if (half[part.neighbor[e]] == half[i]) continue;
      result[half[i]].push_back(i);
      break;
    }
  }
  return result;
}

/// Smallest set of nodes that covers all edges between two halves: by Konig's theorem, from a maximum
/// matching of their boundaries.
class VertexCover {
 public:
  VertexCover(const Graph& part, const std::vector<char>& half)
      : part_(part), half_(half), mate_(part.size(), -1), seen_(part.size(), -1) {}

  std::vector<Index> find() {
    const auto [first, second] = boundaries(part_, half_);
    for (const Index i : first) {
      if (mate_[i] == -1) augment(i, i);
    }
    // Mark nodes reached by alternating paths from unmatched nodes of the first half.
    const Index round = part_.size();
    for (const Index i : first) {
      if (mate_[i] == -1) reach(i, round);
    }
    std::vector<Index> cover;
    for (const Index i : first) {
      if (seen_[i] != round) cover.push_back(i);
    }
    for (const Index i : second) {
      if (seen_[i] == round) cover.push_back(i);
    }
    return cover;
  }

 private:
  /// Match node i of the first half, rematching others if necessary.
  bool augment(Index i, Index round) {
    for (Index e = part_.start[i]; e < part_.start[i + 1]; ++e) {
      const Index j = part_.neighbor[e];
      if (half_[j] == 0 || seen_[j] == round) continue;
      seen_[j] = round;
      if (mate_[j] == -1 || augment(mate_[j], round)) {
        mate_[i] = j;
        mate_[j] = i;
        return true;
      }
    }
    return false;
  }

  void reach(Index i, Index round) {
    seen_[i] = round;
    for (Index e = part_.start[i]; e < part_.start[i + 1]; ++e) {
      const Index j = part_.neighbor[e];
      if (half_[j] == 0 || seen_[j] == round) continue;
      seen_[j] = round;
      // An unmatched j would have enlarged the matching.
      if (seen_[mate_[j]] != round) reach(mate_[j], round);
    }
  }

  const Graph& part_;
  const std::vector<char>& half_;
  std::vector<Index> mate_;
  std::vector<Index> seen_;  // last search that reached the node
};

/// Half of each node (0 or 1), or 2 for the separator. For a connected part.
std::vector<char> bisect(const Graph& part) {
  Coordinates x = embed(part);
  smooth(part, x);
  std::vector<char> best;
  std::size_t fewest = std::numeric_limits<std::size_t>::max();
  for (int k = 0; k < kDirections; ++k) {
    const double angle = std::numbers::pi * k / kDirections;
    std::vector<char> half = halves(x, {std::cos(angle), std::sin(angle)});
    const auto [first, second] = boundaries(part, half);
    const std::size_t size = std::min(first.size(), second.size());
    if (size >= fewest) continue;
    fewest = size;
    best = std::move(half);
  }
  for (const Index i : VertexCover(part, best).find()) best[i] = 2;
  return best;
}

/// Dissects a graph part by part.
class Dissection {
 public:
  explicit Dissection(const Graph& graph) : graph_(graph), number_(graph.size(), -1) {}

  std::vector<Index> run() {
    std::vector<Index> all(graph_.size());
    for (Index k = 0; k < graph_.size(); ++k) all[k] = k;
    dissect(std::move(all));
    return std::move(order_);
  }

 private:
  void dissect(std::vector<Index> nodes) {
    // Components are processed in a loop: as many as there are nodes would be too deep a recursion.
    for (;;) {
      const Graph part = induced(graph_, nodes, number_);
      if (part.size() <= kSmallPart) {
        order_part(nodes);
        return;
      }
      const std::vector<Index> distance = distances(part, 0);
      std::vector<Index> component;
      std::vector<Index> others;
      for (Index k = 0; k < part.size(); ++k) {
        (distance[k] < 0 ? others : component).push_back(nodes[k]);
      }
      if (others.empty()) {
        cut(part, nodes);
        return;
      }
      dissect(std::move(component));
      nodes = std::move(others);
    }
  }

  /// Cut a connected part.
  void cut(const Graph& part, const std::vector<Index>& nodes) {
    std::array<std::vector<Index>, 3> parts;
    const std::vector<char> where = bisect(part);
    for (Index k = 0; k < part.size(); ++k) parts[where[k]].push_back(nodes[k]);
    dissect(std::move(parts[0]));
    dissect(std::move(parts[1]));
    order_.insert(order_.end(), parts[2].begin(), parts[2].end());
  }

  /// Minimum degree on the part and its surrounding separators. The separators form one clique, as they
  /// will after elimination, so that degrees at the part's boundary equal those in the whole graph.
  void order_part(const std::vector<Index>& nodes) {
    std::vector<Index> extended = nodes;
    for (const Index node : nodes) number_[node] = 0;
    for (const Index node : nodes) {
      for (Index e = graph_.start[node]; e < graph_.start[node + 1]; ++e) {
        const Index next = graph_.neighbor[e];
        if (number_[next] >= 0) continue;
        number_[next] = 0;
        extended.push_back(next);
      }
    }
    for (const Index node : extended) number_[node] = -1;
    const Graph inner = induced(graph_, extended, number_);
    const auto size = static_cast<Index>(nodes.size());
    Graph with_clique;
    with_clique.vertex = inner.vertex;
    with_clique.start.push_back(0);
    for (Index k = 0; k < inner.size(); ++k) {
      for (Index e = inner.start[k]; e < inner.start[k + 1]; ++e) {
        if (k < size || inner.neighbor[e] < size) with_clique.neighbor.push_back(inner.neighbor[e]);
      }
      for (Index i = size; k >= size && i < inner.size(); ++i) {
        if (i != k) with_clique.neighbor.push_back(i);
      }
      with_clique.start.push_back(static_cast<Index>(with_clique.neighbor.size()));
    }
    for (const Index k : minimum_degree_order(with_clique)) {
      if (k < size) order_.push_back(nodes[k]);
    }
  }

  const Graph& graph_;
  std::vector<Index> number_;
  std::vector<Index> order_;
};

}  // namespace

std::vector<Index> nested_dissection_order(const Graph& graph) { return Dissection(graph).run(); }

}  // namespace diffcloth::linalg
