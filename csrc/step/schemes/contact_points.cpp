#include "step/schemes/contact_points.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <map>
#include <utility>

namespace diffcloth::step {
namespace {

using contact::Contact;

/// Key of two features; against bodies, of the nearest ones.
using Features = std::pair<contact::Candidate, std::array<Index, 4>>;

Features features(const Contact& contact) { return {contact.pair, contact.pair.vertices}; }

/// Index of the point of each pair of features in a list without duplicate pairs.
class Places {
 public:
  explicit Places(const std::vector<Contact>& contacts) : contacts_(contacts) {}

  /// Index of a contact's features; `end` for a new point. Successive solutions are similar: most
  /// contacts are found directly after the previous one, and the others are looked up.
  std::size_t find(const Contact& contact, std::size_t end) {
    if (next_ < contacts_.size() && features(contacts_[next_]) == features(contact)) {
      return next_++;
    }
    if (by_features_.empty()) {
      for (std::size_t k = 0; k < contacts_.size(); ++k) {
        by_features_.emplace(features(contacts_[k]), k);
      }
    }
    const std::size_t place = by_features_.emplace(features(contact), end).first->second;
    next_ = place + 1;
    return place;
  }

 private:
  const std::vector<Contact>& contacts_;
  std::size_t next_ = 0;
  std::map<Features, std::size_t> by_features_;  // filled at the first lookup
};

/// The point of a pair, with the smaller surface index first; and true if that is the pair's second
/// surface.
std::pair<ContactPoint, bool> placed(const contact::ContactModel& model,
                                     const Contact& c,
                                     const double* x) {
  const std::vector<Index>& owner = model.mesh().vertex_surface;
  const auto& v = c.pair.vertices;
  const int of_a = c.pair.kind == contact::PairKind::kPointTriangle ? 1 : 2;
  ContactPoint point{.first = owner[v[0]], .second = owner[v[3]]};
  std::array<Vec3, 2>& points = point.points;
  for (int i = 0; i < 4; ++i) {
    const double weight = c.closest.c[i];
    points[i < of_a ? 0 : 1] += (i < of_a ? weight : -weight) * row(x, v[i]);
  }
  const bool is_turned = point.first > point.second;
  if (is_turned) {
    std::swap(point.first, point.second);
    std::swap(points[0], points[1]);
  }
  const Vec3 way = points[1] - points[0];
  const double distance = way.norm();
  point.normal = distance > 0.0 ? Vec3(way / distance) : Vec3(Vec3::Zero());
  point.gap = distance - c.xi;
  // Move from the skeletons of round bodies to their surfaces.
  points[0] += model.mesh().radius[point.first] * point.normal;
  points[1] -= model.mesh().radius[point.second] * point.normal;
  return {point, is_turned};
}

double normal_force(const Contact& c) {
  return -c.kappa * c.weight * c.mollifier * c.barrier.b1 * 2.0 * std::sqrt(c.closest.d_sq);
}

}  // namespace

std::vector<ContactPoint> contact_points(const Problem& problem,
                                         const std::vector<Contact>& contacts,
                                         const contact::FrictionSet* friction,
                                         const std::vector<double>& x) {
  std::vector<ContactPoint> points;
  if (!problem.contact) return points;
  const contact::ContactModel& model = *problem.contact;
  points.reserve(contacts.size());
  for (const Contact& c : contacts) {
    points.push_back(placed(model, c, x.data()).first);
    points.back().normal_force = normal_force(c);
  }
  if (friction == nullptr) return points;
  const contact::FrictionSet::Slips& slips = friction->slips(x.data());
  Places places(contacts);
  for (std::size_t k = 0; k < slips.size(); ++k) {
    const contact::FrictionSet::Entry& entry = friction->entries()[k];
    const auto [point, is_turned] = placed(model, entry.lag, x.data());
    const std::size_t place = places.find(entry.lag, points.size());
    if (place == points.size()) points.push_back(point);
    // Friction opposes the motion of the pair's first feature relative to the second one.
    const Vec3 on_b = (entry.mu * entry.lambda) * slips[k].force();
    points[place].tangential_force += is_turned ? Vec3(-on_b) : on_b;
  }
  return points;
}

}  // namespace diffcloth::step
