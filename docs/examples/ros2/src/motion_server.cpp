#include "motion_server.hpp"

#include <algorithm>
#include <utility>

MotionServer::MotionServer(Ports ports, double period, double lead)
: ports_(std::move(ports)), period_(period), lead_(lead), thread_([this] { run(); }) {}

MotionServer::~MotionServer() {
  post(nullptr);  // the last event; a trajectory that was sent ends at rest without this process
  thread_.join();
}

void MotionServer::request(const void *id, MotionRequest request) {
  post([this, id, request = std::move(request)] { begin(id, request); });
}

void MotionServer::cancel(const void *id) {
  post([this, id] { stop(id); });
}

void MotionServer::answer(long goal, Answer answer, std::string text) {
  post([this, goal, answer, text = std::move(text)] { conclude(goal, answer, text); });
}

void MotionServer::post(std::function<void()> event) {
  const std::lock_guard<std::mutex> lock(mutex_);
  events_.push_back(std::move(event));
  wake_.notify_one();
}

void MotionServer::run() {
  while (true) {
    std::unique_lock<std::mutex> lock(mutex_);
    wake_.wait(lock, [this] { return !events_.empty(); });
    const std::function<void()> event = std::move(events_.front());
    events_.pop_front();
    lock.unlock();
    if (!event) return;
    event();
  }
}

void MotionServer::begin(const void *id, const MotionRequest &request) {
  if (running_) return request.finish({Status::refused, "BUSY: a motion runs; cancel it first"});
  std::string fault = request.fault.empty() ? motions_.plan(request.boundary) : request.fault;
  if (!fault.empty()) return request.finish({Status::refused, std::move(fault)});
  running_ = Running{id, request.finish};
  start_ = ports_.now() + lead_;
  send(0);
}

// A stop is a trajectory with the same start time, equal to the motion up to the stop's begin. The
// controller may switch to it at any time before, without a jump.
void MotionServer::stop(const void *id) {
  if (!running_ || running_->id != id || running_->canceled) return;
  running_->canceled = true;
  for (double lead = lead_; lead < motions_.duration(); lead *= 2) {
    const double time = std::max(ports_.now() - start_, 0.0);
    const std::optional<double> begin = motions_.find_stop(time + lead);
    if (!begin) return;  // the arm comes to rest at the end of the motion
    if (ports_.now() - start_ < *begin - lead / 2) {  // else finding it took too long
      running_->stop = send(time);
      return;
    }
  }
}

long MotionServer::send(double from) {
  running_->open++;
  ports_.send(++goals_, start_, motions_.sample(from, period_));
  return goals_;
}

// The request ends when the controller has answered every goal. The last one that it accepted decides.
void MotionServer::conclude(long goal, Answer answer, const std::string &text) {
  if (!running_) return;
  Running &running = *running_;
  if (goal > running.last && answer != Answer::rejected) {
    running.last = goal;
    const bool stopped = goal == running.stop;
    if (answer == Answer::aborted) running.outcome = {Status::failed, text};
    else if (stopped) running.outcome = {Status::stopped, "the arm rests on the path"};
    else running.outcome = {Status::reached, running.canceled ? "no stop before the end" : ""};
  }
  if (--running.open > 0) return;
  if (running.last == 0) running.outcome = {Status::failed, "the controller rejected it: " + text};
  const Running ended = *std::exchange(running_, std::nullopt);
  ended.finish(ended.outcome);
}
