#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "common/stopwatch.h"
#include "common/types.h"
#include "contact/friction_set.h"
#include "solver/linear_system.h"
#include "solver/stopping.h"

namespace diffcloth::step {

/// Outcome of an environment's step in the report.
enum class Result : std::int32_t {
  kConverged = 0,
  kNotConverged = 1,
  kInfeasibleMotion = 2,
  kIntersectingStart = 3,
};

/// Contacts of two surfaces; the first has the smaller index.
struct PairContacts {
  Index first = 0;
  Index second = 0;
  Index count = 0;
  Vec3 force = Vec3::Zero();  ///< force of the first on the second, barrier and friction [N]
};

/// A contact between two surfaces; the first has the smaller index.
struct ContactPoint {
  Index first = 0;
  Index second = 0;
  std::array<Vec3, 2> points{Vec3::Zero(), Vec3::Zero()};  ///< nearest point on each surface [m]
  Vec3 normal = Vec3::Zero();            ///< direction from the first to the second
  double gap = 0.0;                      ///< distance of the surfaces, without their thickness [m]
  double normal_force = 0.0;             ///< force of the first on the second along the normal [N]
  Vec3 tangential_force = Vec3::Zero();  ///< friction of the first on the second [N]
};

struct Report {
  Result result = Result::kConverged;
  solver::Criterion criterion = solver::Criterion::kNoSolve;  ///< end of the deciding solve
  bool certified = true;  ///< every solve ended with a factor of its Hessian
  Index iterations = 0;
  double residual = 0.0;          ///< |p|_inf / h [m/s]
  double minimum_distance = 0.0;  ///< smallest in contact; infinite without contact [m]
  Index contact_count = 0;
  double motion_fraction = 1.0;
  std::vector<double> root_poses;  ///< poses at the end of an incomplete motion [T, 7]; else empty
  Index taking_off = 0;            ///< nodes in dry frictional contact, by the cases of its law
  Index sticking = 0;
  Index slipping = 0;
  solver::Counts counts;
  Seconds seconds{};
  double cpu_seconds = 0.0;  ///< processor time of the threads of the environment [s]
  std::string message;
  std::vector<PairContacts> pairs;   ///< pairs in ascending order
  std::vector<ContactPoint> points;  ///< contacts with barrier and friction, not nodes

  /// Call visit(name, value) for every number except times.
  template <class Visit>
  void for_each(Visit&& visit) const {
    visit("status", static_cast<std::int64_t>(result));
    visit("criterion", static_cast<std::int64_t>(criterion));
    visit("certified", static_cast<std::int64_t>(certified));
    visit("iterations", static_cast<std::int64_t>(iterations));
    visit("residual", residual);
    visit("minimum_distance", minimum_distance);
    visit("contact_count", static_cast<std::int64_t>(contact_count));
    visit("motion_fraction", motion_fraction);
    visit("cpu_seconds", cpu_seconds);
    visit("count_exact", static_cast<std::int64_t>(counts.exact));
    visit("count_chord", static_cast<std::int64_t>(counts.chord));
    visit("count_projected", static_cast<std::int64_t>(counts.projected));
    visit("count_negative_curvature", static_cast<std::int64_t>(counts.negative_curvature));
    visit("count_local_global", counts.local_global);
    visit("count_left_to_newton", static_cast<std::int64_t>(counts.left_to_newton));
    visit("count_factorizations", static_cast<std::int64_t>(counts.factorizations));
    visit("count_in_doubles", static_cast<std::int64_t>(counts.in_doubles));
    visit("count_analyses", static_cast<std::int64_t>(counts.analyses));
    visit("count_taking_off", static_cast<std::int64_t>(taking_off));
    visit("count_sticking", static_cast<std::int64_t>(sticking));
    visit("count_slipping", static_cast<std::int64_t>(slipping));
  }
};

/// Accumulates in a report the contacts of each pair of surfaces and the force of the first on the
/// second.
class PairTally {
 public:
  explicit PairTally(Report& report) : pairs_(report.pairs) {}

  /// Count the contacts of a solution, and add the forces of barrier and friction there.
  ///
  /// @param contacts  at the solution
  /// @param friction  lagged friction of the solution; null if there is none
  void add(const contact::ContactModel& model,
           const std::vector<contact::Contact>& contacts,
           const contact::FrictionSet* friction,
           const std::vector<double>& x);

  /// Count one contact of two surfaces, the smaller first.
  ///
  /// @param force  of the first on the second [N]
  void add(Index first, Index second, const Vec3& force);

 private:
  PairContacts& of(Index first, Index second);

  std::vector<PairContacts>& pairs_;
};

}  // namespace diffcloth::step
