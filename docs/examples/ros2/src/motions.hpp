// One request as one or two planned motions: to the goal and, after a hit, to rest. No ROS here.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "planner.hpp"

using Joints = std::array<double, planner::joints>;

struct Boundary {
  Joints start_q{}, goal_q{}, goal_dq{};  // rad, rad/s; at rest at the start
  std::optional<Joints> rest_q;           // rad; for goals with a velocity
};

struct Point {
  double time = 0;  // s since the start of the first motion
  Joints q{}, dq{}, ddq{};
};

class Motions {
public:
  // Plan all motions; return why there is none, or an empty text.
  std::string plan(const Boundary &boundary);
  double duration() const;  // s, of all motions
  // States every period [s] from a time [s] to the end, which is at rest.
  std::vector<Point> sample(double from, double period) const;
  // Find the earliest stop after a time [s]; sample then ends with it. Return its begin [s].
  std::optional<double> find_stop(double time);

private:
  Point state(double time) const;
  double end() const;
  double offset(int motion) const { return motion == 0 ? 0 : motions_[0].duration; }

  std::array<planner::Motion, 2> motions_{};
  int count_ = 0;
  int stopped_ = -1;  // the motion with the stop
  planner::Stop stop_{};
  planner::Memory memory_{};
};

// Put values into the order of the planner's joints, which have these names here. Return the first
// fault by name, or an empty text.
std::string in_order(
  const std::vector<std::string> &joints, const std::vector<std::string> &names,
  const std::vector<double> &values, const std::string &what, Joints &ordered);

// Compare the measured state with the start of a motion; return the first fault, or an empty text.
std::string start_fault(
  const std::vector<std::string> &joints, const Joints &start_q, const Joints &measured_q,
  const Joints &measured_dq, double position_tolerance, double velocity_tolerance);
