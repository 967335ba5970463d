#include "bodies/smooth_function.h"

#include <algorithm>

namespace diffcloth::bodies {

Linearized::Linearized(const SmoothFunction& function,
                       SmoothFunction::Inputs<double> in,
                       const std::vector<char>& varies)
    : function_(function), varies_(varies) {
  const Recorder recorder(recording_);
  std::vector<std::vector<Recorded>> inputs(in.size());
  std::vector<const Recorded*> given(in.size(), nullptr);
  for (std::size_t i = 0; i < in.size(); ++i) {
    if (in[i] == nullptr) continue;
    const std::size_t size = function.inputs()[i].size();
    inputs[i].reserve(size);
    for (std::size_t k = 0; k < size; ++k) {
      inputs[i].push_back(varies[i] != 0 ? Recorded::variable(in[i][k]) : Recorded(in[i][k]));
    }
    given[i] = inputs[i].data();
  }
  std::vector<Recorded*> results;
  for (const SmoothFunction::Array& output : function.outputs()) {
    results.push_back(outputs_.emplace_back(output.size()).data());
  }
  function.evaluate(given, results);
}

void Linearized::pull_back(std::span<const double* const> cotangents,
                           std::span<double* const> gradients) {
  change_.assign(recording_.size(), 0.0);
  for (std::size_t o = 0; o < outputs_.size(); ++o) {
    if (cotangents[o] == nullptr) continue;
    for (std::size_t k = 0; k < outputs_[o].size(); ++k) {
      change_[outputs_[o][k].place] += cotangents[o][k];
    }
  }
  recording_.pull_back(change_);
  const double* variable = change_.data() + 1;
  for (std::size_t i = 0; i < varies_.size(); ++i) {
    if (varies_[i] == 0) continue;
    const std::size_t size = function_.inputs()[i].size();
    std::copy_n(variable, size, gradients[i]);
    variable += size;
  }
}

void Linearized::push_forward(std::span<const double* const> given,
                              std::span<double* const> tangents) {
  change_.assign(recording_.size(), 0.0);
  double* variable = change_.data() + 1;
  for (std::size_t i = 0; i < varies_.size(); ++i) {
    if (varies_[i] == 0) continue;
    const std::size_t size = function_.inputs()[i].size();
    if (given[i] != nullptr) std::copy_n(given[i], size, variable);
    variable += size;
  }
  recording_.push_forward(static_cast<std::size_t>(variable - change_.data()) - 1, change_);
  for (std::size_t o = 0; o < outputs_.size(); ++o) {
    for (std::size_t k = 0; k < outputs_[o].size(); ++k) {
      tangents[o][k] = change_[outputs_[o][k].place];
    }
  }
}

}  // namespace diffcloth::bodies
