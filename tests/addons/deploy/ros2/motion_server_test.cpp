// Requests, cancels and answers of a controller that this program plays. The rows of the standard
// input are start_q, goal_q, goal_dq and rest_q; the first argument is 1 if rest_q applies.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <future>
#include <iostream>
#include <memory>

#include "motion_server.hpp"

#define CHECK(condition)                                                    \
  do {                                                                      \
    if (!(condition)) {                                                     \
      std::fprintf(stderr, "line %d: %s\n", __LINE__, #condition);          \
      std::exit(1);                                                         \
    }                                                                       \
  } while (false)

namespace {

const double kPeriod = 0.002, kLead = 0.05;

struct Goal {
  long number;
  double start;
  std::vector<Point> points;
};

// A server with a clock that stands still until it is set, and its goals in a list.
struct Bench {
  std::mutex mutex;
  std::condition_variable wake;
  std::deque<Goal> goals;
  double time = 100;
  MotionServer server{
    {[this] {
       const std::lock_guard<std::mutex> lock(mutex);
       return time;
     },
     [this](long number, double start, const std::vector<Point> &points) {
       const std::lock_guard<std::mutex> lock(mutex);
       goals.push_back({number, start, points});
       wake.notify_one();
     }},
    kPeriod, kLead};

  Goal next() {
    std::unique_lock<std::mutex> lock(mutex);
    CHECK(wake.wait_for(lock, std::chrono::seconds(60), [this] { return !goals.empty(); }));
    Goal goal = goals.front();
    goals.pop_front();
    return goal;
  }
  void set(double value) {
    const std::lock_guard<std::mutex> lock(mutex);
    time = value;
  }
  std::future<Outcome> request(const void *id, const Boundary &boundary, std::string fault = "") {
    auto promise = std::make_shared<std::promise<Outcome>>();
    server.request(
      id, {boundary, std::move(fault), [promise](const Outcome &end) { promise->set_value(end); }});
    return promise->get_future();
  }
};

bool has(const std::string &text, const std::string &part) {
  return text.find(part) != std::string::npos;
}

double largest(const Joints &values) {
  double most = 0;
  for (double value : values) most = std::max(most, std::abs(value));
  return most;
}

double distance(const Joints &a, const Joints &b) {
  Joints difference{};
  for (size_t k = 0; k < a.size(); k++) difference[k] = a[k] - b[k];
  return largest(difference);
}

// Times increase, positions follow from velocities, velocities from accelerations, and the end rests.
// A transport arrives with an acceleration, which ends with it: the last interval has no check of it.
void check_points(const std::vector<Point> &points) {
  for (size_t k = 0; k + 1 < points.size(); k++) {
    const Point &a = points[k], &b = points[k + 1];
    const double h = b.time - a.time;
    CHECK(h > 0.4 * kPeriod && h < 1.6 * kPeriod);
    for (size_t j = 0; j < a.q.size(); j++) {
      CHECK(std::abs(b.q[j] - a.q[j] - h * (a.dq[j] + b.dq[j]) / 2) < 1e-4);
      if (k + 2 < points.size())
        CHECK(std::abs(b.dq[j] - a.dq[j] - h * (a.ddq[j] + b.ddq[j]) / 2) < 0.01);
    }
  }
  CHECK(largest(points.back().dq) == 0 && largest(points.back().ddq) == 0);
}

void check_reached(const Boundary &boundary) {
  Bench bench;
  int id = 0, other = 0;
  std::future<Outcome> end = bench.request(&id, boundary);
  const Goal goal = bench.next();
  CHECK(goal.start == 100 + kLead);
  check_points(goal.points);
  CHECK(distance(goal.points.front().q, boundary.start_q) < 1e-6);
  CHECK(distance(goal.points.back().q, boundary.rest_q.value_or(boundary.goal_q)) < 1e-6);
  const Outcome busy = bench.request(&other, boundary).get();
  CHECK(busy.status == Status::refused && has(busy.text, "BUSY"));
  bench.server.cancel(&other);  // not the one that runs
  bench.server.answer(goal.number, Answer::succeeded, "");
  CHECK(end.get().status == Status::reached);
  CHECK(bench.goals.empty());
  end = bench.request(&other, boundary);  // the server is free again
  bench.server.answer(bench.next().number, Answer::aborted, "tolerance");
  const Outcome failed = end.get();
  CHECK(failed.status == Status::failed && failed.text == "tolerance");
  end = bench.request(&id, boundary);
  bench.server.answer(bench.next().number, Answer::rejected, "no");
  CHECK(end.get().status == Status::failed);
}

// Return whether there was a stop after a share of the motion.
bool check_cancel(const Boundary &boundary, double share) {
  Bench bench;
  int id = 0;
  std::future<Outcome> end = bench.request(&id, boundary);
  const Goal goal = bench.next();
  Motions motions;
  CHECK(motions.plan(boundary).empty());
  const double time = share * motions.duration();
  const std::optional<double> begin = motions.find_stop(std::max(time, 0.0) + kLead);
  bench.set(goal.start + time);
  bench.server.cancel(&id);
  bench.server.cancel(&id);  // once more changes nothing
  if (!begin) {
    bench.server.answer(goal.number, Answer::succeeded, "");
    const Outcome outcome = end.get();
    CHECK(outcome.status == Status::reached && has(outcome.text, "no stop"));
    return false;
  }
  const Goal stop = bench.next();
  check_points(stop.points);
  CHECK(stop.start == goal.start && stop.points.front().time <= std::max(time, 0.0) + 1e-9);
  CHECK(*begin >= std::max(time, 0.0) + kLead - 1e-9);
  CHECK(stop.points.back().time < motions.duration());
  Motions whole;
  CHECK(whole.plan(boundary).empty());
  for (const Point &point : stop.points) {  // no jump: equal to the motion up to the stop's begin
    if (point.time > *begin) break;
    const Point planned = whole.sample(point.time, kPeriod).front();
    CHECK(distance(point.q, planned.q) < 1e-9 && distance(point.dq, planned.dq) < 1e-9);
  }
  bench.server.answer(goal.number, Answer::aborted, "preempted");
  bench.server.answer(stop.number, Answer::succeeded, "");
  CHECK(end.get().status == Status::stopped);
  return true;
}

// The controller finishes the motion before the stop arrives, and rejects the stop.
void check_late_stop(const Boundary &boundary) {
  Bench bench;
  int id = 0;
  std::future<Outcome> end = bench.request(&id, boundary);
  const Goal goal = bench.next();
  bench.server.cancel(&id);
  const Goal stop = bench.next();
  bench.server.answer(goal.number, Answer::succeeded, "");
  bench.server.answer(stop.number, Answer::rejected, "in the past");
  CHECK(end.get().status == Status::reached);
}

void check_refusals(Boundary boundary) {
  Bench bench;
  int id = 0;
  const Outcome fault = bench.request(&id, boundary, "joint b is away").get();
  CHECK(fault.status == Status::refused && fault.text == "joint b is away");
  Boundary moving = boundary;
  moving.goal_dq[0] = 0.5;
  moving.rest_q.reset();
  CHECK(has(bench.request(&id, moving).get().text, "rest_q is empty"));
  boundary.goal_q[0] = std::nan("");
  CHECK(has(bench.request(&id, boundary).get().text, "to the goal: NOT_FINITE"));
  CHECK(bench.goals.empty());
}

void check_names(const Joints &q) {
  const std::vector<std::string> joints(planner::joint_names, planner::joint_names + planner::joints);
  std::vector<std::string> names(joints.rbegin(), joints.rend());
  std::vector<double> values(q.rbegin(), q.rend());
  Joints ordered{};
  CHECK(in_order(joints, names, values, "goal_q", ordered).empty() && ordered == q);
  values[0] = std::nan("");
  CHECK(has(in_order(joints, names, values, "goal_q", ordered), joints.back()));
  values.pop_back();
  CHECK(has(in_order(joints, names, values, "goal_q", ordered), "goal_q has"));
  names.pop_back();
  CHECK(has(in_order(joints, names, values, "goal_q", ordered), "no value for joint " + joints[0]));
  Joints away = q, dq{};
  CHECK(start_fault(joints, q, q, dq, 0.01, 0.01).empty());
  away[1] += 0.02;
  CHECK(has(start_fault(joints, q, away, dq, 0.01, 0.01), "joint " + joints[1] + " is at"));
  dq[2] = std::nan("");
  CHECK(has(start_fault(joints, q, q, dq, 0.01, 0.01), "joint " + joints[2] + " moves"));
}

bool read(Joints &values) {
  for (double &value : values)
    if (!(std::cin >> value)) return false;
  return true;
}

}  // namespace

int main(int, char **argv) {
  int planned = 0, stops = 0, ends = 0;
  Boundary boundary;
  for (Joints rest{}; read(boundary.start_q) && read(boundary.goal_q) && read(boundary.goal_dq) &&
                      read(rest);) {
    if (std::atoi(argv[1])) boundary.rest_q = rest;
    Motions motions;
    if (!motions.plan(boundary).empty()) continue;
    if (planned++ == 0) {
      check_refusals(boundary);
      check_names(boundary.start_q);
      check_late_stop(boundary);
    }
    check_reached(boundary);
    for (double share : {-0.02, 0.0, 0.2, 0.4, 0.6, 0.8, 0.97})
      check_cancel(boundary, share) ? stops++ : ends++;
  }
  std::printf("%d %d %d\n", planned, stops, ends);
  return 0;
}
