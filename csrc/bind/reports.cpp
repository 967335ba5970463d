#include "bind/reports.h"

#include <algorithm>
#include <cstddef>

#include <nanobind/stl/string.h>

namespace diffcloth::bind {
namespace {

/// Call visit(name, value) for every number of a report, seconds of the phases included.
template <class Visit>
void for_each_number(const step::Report& report, Visit&& visit) {
  report.for_each(visit);
  for (std::size_t k = 0; k < kPhaseCount; ++k) visit(kPhaseNames[k], report.seconds[k]);
}

}  // namespace

std::vector<std::string> number_names() {
  std::vector<std::string> names;
  step::Report().for_each([&](const char* name, auto /*value*/) { names.emplace_back(name); });
  for (const char* const phase : kPhaseNames) names.push_back(std::string("seconds_") + phase);
  return names;
}

nb::list to_lists(const std::vector<step::Report>& reports) {
  std::vector<nb::list> columns;
  for (const step::Report& report : reports) {
    std::size_t k = 0;
    for_each_number(report, [&](const char* /*name*/, auto value) {
      if (k == columns.size()) columns.emplace_back();
      columns[k++].append(value);
    });
  }
  nb::list lists;
  for (const nb::list& column : columns) lists.append(column);
  return lists;
}

nb::dict ended_poses(const std::vector<step::Report>& reports) {
  nb::dict ended;
  for (std::size_t e = 0; e < reports.size(); ++e) {
    const std::vector<double>& poses = reports[e].root_poses;
    if (poses.empty()) continue;
    Owned<double> owned = make_array<double>({poses.size() / 7, 7});
    std::ranges::copy(poses, owned.data);
    ended[nb::int_(e)] = owned.array;
  }
  return ended;
}

nb::list pair_contacts(const std::vector<step::Report>& reports) {
  nb::list environments;
  for (const step::Report& report : reports) {
    nb::list pairs;
    for (const step::PairContacts& pair : report.pairs) {
      const Vec3& f = pair.force;
      pairs.append(
          nb::make_tuple(pair.first, pair.second, pair.count, nb::make_tuple(f[0], f[1], f[2])));
    }
    environments.append(pairs);
  }
  return environments;
}

nb::list contact_points(const std::vector<step::Report>& reports) {
  constexpr std::size_t kColumns = 16;
  nb::list environments;
  for (const step::Report& report : reports) {
    Owned<double> owned = make_array<double>({report.points.size(), kColumns});
    double* out = owned.data;
    for (const step::ContactPoint& point : report.points) {
      *out++ = point.first;
      *out++ = point.second;
      for (const Vec3& v : {point.points[0], point.points[1], point.normal}) {
        out = std::copy_n(v.data(), 3, out);
      }
      *out++ = point.gap;
      *out++ = point.normal_force;
      out = std::copy_n(point.tangential_force.data(), 3, out);
    }
    environments.append(owned.array);
  }
  return environments;
}

}  // namespace diffcloth::bind
