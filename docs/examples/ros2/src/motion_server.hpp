// Requests, plans, stops and answers of the controller, one after another on a thread of its own.
// No ROS here: the node gives a clock and a function that sends trajectories.
#pragma once

#include <condition_variable>
#include <deque>
#include <functional>
#include <mutex>
#include <thread>

#include "motions.hpp"

enum class Status { reached, stopped, refused, failed };
enum class Answer { rejected, succeeded, aborted };

struct Outcome {
  Status status;
  std::string text;
};

struct MotionRequest {
  Boundary boundary;
  std::string fault;                            // found before planning, such as a wrong start
  std::function<void(const Outcome &)> finish;  // called once, on the worker's thread
};

struct Ports {
  std::function<double()> now;  // s
  // Send goal number GOAL: points at times since a start [s] by now().
  std::function<void(long goal, double start, const std::vector<Point> &)> send;
};

class MotionServer {
public:
  // The period [s] of points, and the lead [s] between a decision and the first effect of it.
  MotionServer(Ports ports, double period, double lead);
  ~MotionServer();

  // These return at once. A request while another one runs is refused as BUSY. The id names a
  // request while it runs.
  void request(const void *id, MotionRequest request);
  void cancel(const void *id);
  void answer(long goal, Answer answer, std::string text);

private:
  struct Running {
    const void *id;
    std::function<void(const Outcome &)> finish;
    bool canceled = false;
    int open = 0;       // goals that the controller has not answered
    long last = 0;      // the last goal that the controller accepted,
    Outcome outcome{};  // and what became of it
    long stop = 0;      // the goal that stops, if there is one
  };

  void post(std::function<void()> event);
  void run();
  void begin(const void *id, const MotionRequest &request);
  void stop(const void *id);
  void conclude(long goal, Answer answer, const std::string &text);
  long send(double from);

  const Ports ports_;
  const double period_, lead_;
  Motions motions_;  // of the worker's thread, as everything up to the mutex
  std::optional<Running> running_;
  double start_ = 0;
  long goals_ = 0;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::function<void()>> events_;
  std::thread thread_;
};
