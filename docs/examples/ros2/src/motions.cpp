#include "motions.hpp"

#include <algorithm>
#include <cmath>

namespace {

void copy(const Joints &from, double *to) { std::copy(from.begin(), from.end(), to); }

bool moves(const Joints &dq) {
  return std::any_of(dq.begin(), dq.end(), [](double value) { return value != 0; });
}

std::string fault_of(int code, const char *part) {
  if (code == 0) return "";
  return std::string(part) + ": " + planner::code_names.at(static_cast<size_t>(code));
}

}  // namespace

std::string Motions::plan(const Boundary &boundary) {
  count_ = 0;
  stopped_ = -1;
  if (moves(boundary.goal_dq) && !boundary.rest_q)
    return "rest_q is empty, and goal_dq is not zero: the arm must rest at the end";
  if (!moves(boundary.goal_dq) && boundary.rest_q)
    return "rest_q is given, but the motion already ends at rest at goal_q";
  planner::Request request{};
  copy(boundary.start_q, request.start_q);
  copy(boundary.goal_q, request.goal_q);
  copy(boundary.goal_dq, request.goal_dq);
  std::string fault = fault_of(planner::plan(&request, &motions_[0], &memory_), "to the goal");
  if (!fault.empty()) return fault;
  if (boundary.rest_q) {
    // At its end a motion counts as at rest, so the state is the one a nanosecond before.
    planner::Request rest{};
    planner::state(
      &motions_[0], motions_[0].duration - 1e-9, rest.start_q, rest.start_dq, rest.start_ddq);
    copy(*boundary.rest_q, rest.goal_q);
    fault = fault_of(planner::plan(&rest, &motions_[1], &memory_), "from the goal to rest");
    if (!fault.empty()) return fault;
  }
  count_ = boundary.rest_q ? 2 : 1;
  return "";
}

double Motions::duration() const {
  return count_ == 0 ? 0 : offset(count_ - 1) + motions_[static_cast<size_t>(count_ - 1)].duration;
}

double Motions::end() const {
  return stopped_ < 0 ? duration() : offset(stopped_) + stop_.begin + stop_.braking_time;
}

Point Motions::state(double time) const {
  const int motion = count_ == 2 && time >= offset(1) ? 1 : 0;
  const planner::Motion &at = motions_[static_cast<size_t>(motion)];
  const double local = time - offset(motion);
  Point point{time, {}, {}, {}};
  if (motion == stopped_)
    planner::stop_state(&at, &stop_, local, point.q.data(), point.dq.data(), point.ddq.data());
  else
    planner::state(&at, local, point.q.data(), point.dq.data(), point.ddq.data());
  return point;
}

std::vector<Point> Motions::sample(double from, double period) const {
  std::vector<Point> points;
  if (count_ == 0) return points;
  // The last step is between half a period and one and a half.
  for (int k = 0; from + (k + 0.5) * period < end(); k++) points.push_back(state(from + k * period));
  points.push_back(state(end()));
  // A controller holds the last point: at rest, without the acceleration of the arrival.
  points.back().dq.fill(0);
  points.back().ddq.fill(0);
  return points;
}

std::optional<double> Motions::find_stop(double time) {
  for (int motion = 0; motion < count_; motion++) {
    const double local = std::max(time - offset(motion), 0.0);
    planner::Stop stop{};
    if (!planner::find_stop(&motions_[static_cast<size_t>(motion)], local, &memory_, &stop)) continue;
    stop_ = stop;
    stopped_ = motion;
    return offset(motion) + stop.begin;
  }
  return std::nullopt;
}

std::string in_order(
  const std::vector<std::string> &joints, const std::vector<std::string> &names,
  const std::vector<double> &values, const std::string &what, Joints &ordered) {
  if (values.size() != names.size())
    return what + " has " + std::to_string(values.size()) + " values for " +
           std::to_string(names.size()) + " joints";
  for (size_t k = 0; k < ordered.size(); k++) {
    const auto found = std::find(names.begin(), names.end(), joints[k]);
    if (found == names.end()) return what + " has no value for joint " + joints[k];
    ordered[k] = values[static_cast<size_t>(found - names.begin())];
    if (!std::isfinite(ordered[k])) return what + " is not finite for joint " + joints[k];
  }
  return "";
}

std::string start_fault(
  const std::vector<std::string> &joints, const Joints &start_q, const Joints &measured_q,
  const Joints &measured_dq, double position_tolerance, double velocity_tolerance) {
  for (size_t k = 0; k < start_q.size(); k++) {
    if (!(std::abs(measured_q[k] - start_q[k]) <= position_tolerance))  // true for NaN
      return "joint " + joints[k] + " is at " + std::to_string(measured_q[k]) + ", not at start_q " +
             std::to_string(start_q[k]);
    if (!(std::abs(measured_dq[k]) <= velocity_tolerance))
      return "joint " + joints[k] + " moves at " + std::to_string(measured_dq[k]);
  }
  return "";
}
