// The part of rclcpp that the example uses, declared by hand for a compiler's check. Nothing is defined.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>

#include "builtin_interfaces/msg/duration.hpp"
#include "builtin_interfaces/msg/time.hpp"

namespace rclcpp {

enum class ClockType : int { RCL_ROS_TIME = 1 };
using rcl_clock_type_t = ClockType;

class Duration {
public:
  static Duration from_seconds(double seconds);
  double seconds() const;
  operator builtin_interfaces::msg::Duration() const;
};

class Time {
public:
  Time(int64_t nanoseconds, rcl_clock_type_t type);
  Time(const builtin_interfaces::msg::Time &time, rcl_clock_type_t type = ClockType::RCL_ROS_TIME);
  Duration operator-(const Time &other) const;
  double seconds() const;
  operator builtin_interfaces::msg::Time() const;
};

class Clock {
public:
  using SharedPtr = std::shared_ptr<Clock>;
  rcl_clock_type_t get_clock_type() const noexcept;
};

class QoS {};
class SensorDataQoS : public QoS {};

template <typename MessageT>
class Subscription {
public:
  using SharedPtr = std::shared_ptr<Subscription>;
};

class Node : public std::enable_shared_from_this<Node> {
public:
  using SharedPtr = std::shared_ptr<Node>;
  explicit Node(const std::string &name);
  virtual ~Node();
  Time now() const;
  Clock::SharedPtr get_clock();
  template <typename ParameterT>
  ParameterT declare_parameter(const std::string &name, const ParameterT &default_value);
  template <typename MessageT>
  typename Subscription<MessageT>::SharedPtr create_subscription(
    const std::string &topic, const QoS &qos,
    std::function<void(typename MessageT::ConstSharedPtr)> callback);
};

void init(int argc, const char *const *argv);
void spin(Node::SharedPtr node);
bool shutdown();

}  // namespace rclcpp
