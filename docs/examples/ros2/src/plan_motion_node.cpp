// The ROS side: an action server for PlanMotion, and a client of a joint trajectory controller.
#include <cmath>
#include <memory>
#include <stdexcept>

#include "cnpgen_planner/action/plan_motion.hpp"
#include "control_msgs/action/follow_joint_trajectory.hpp"
#include "motion_server.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_action/rclcpp_action.hpp"
#include "sensor_msgs/msg/joint_state.hpp"

using PlanMotion = cnpgen_planner::action::PlanMotion;
using Follow = control_msgs::action::FollowJointTrajectory;
using Handle = rclcpp_action::ServerGoalHandle<PlanMotion>;

class PlanMotionNode : public rclcpp::Node {
public:
  PlanMotionNode() : Node("plan_motion") {
    if (joints_.size() != planner::joints)
      throw std::invalid_argument("joint_names: one name for each joint of the planner, in its order");
    states_ = create_subscription<sensor_msgs::msg::JointState>(
      "joint_states", rclcpp::SensorDataQoS(),
      [this](sensor_msgs::msg::JointState::ConstSharedPtr state) { measured_ = state; });
    actions_ = rclcpp_action::create_server<PlanMotion>(
      this, "plan_motion",
      [](const rclcpp_action::GoalUUID &, std::shared_ptr<const PlanMotion::Goal>) {
        return rclcpp_action::GoalResponse::ACCEPT_AND_EXECUTE;  // refusals are results with a text
      },
      [this](std::shared_ptr<Handle> handle) {
        server_.cancel(handle.get());
        return rclcpp_action::CancelResponse::ACCEPT;
      },
      [this](std::shared_ptr<Handle> handle) { accept(handle); });
  }

private:
  void accept(const std::shared_ptr<Handle> &handle) {
    MotionRequest request;
    request.fault = read(*handle->get_goal(), request.boundary);
    request.finish = [handle](const Outcome &outcome) { finish(*handle, outcome); };
    server_.request(handle.get(), std::move(request));
  }

  // Read a goal in the planner's order of joints; return its first fault, or an empty text.
  std::string read(const PlanMotion::Goal &goal, Boundary &boundary) const {
    const auto &names = goal.joint_names;
    Joints q{}, dq{}, rest{};
    std::string fault = in_order(joints_, names, goal.start_q, "start_q", boundary.start_q);
    if (fault.empty()) fault = in_order(joints_, names, goal.goal_q, "goal_q", boundary.goal_q);
    if (fault.empty() && !goal.goal_dq.empty())
      fault = in_order(joints_, names, goal.goal_dq, "goal_dq", boundary.goal_dq);
    if (fault.empty() && !goal.rest_q.empty()) {
      fault = in_order(joints_, names, goal.rest_q, "rest_q", rest);
      boundary.rest_q = rest;
    }
    if (!fault.empty()) return fault;
    if (!controller_->action_server_is_ready()) return "the controller is not there";
    if (!measured_ || (now() - rclcpp::Time(measured_->header.stamp)).seconds() > max_age_)
      return "joint_states: nothing in the last " + std::to_string(max_age_) + " s";
    fault = in_order(joints_, measured_->name, measured_->position, "joint_states position", q);
    if (fault.empty())
      fault = in_order(joints_, measured_->name, measured_->velocity, "joint_states velocity", dq);
    if (!fault.empty()) return fault;
    return start_fault(joints_, boundary.start_q, q, dq, start_tolerance_, rest_tolerance_);
  }

  static void finish(Handle &handle, const Outcome &outcome) {
    using Result = PlanMotion::Result;
    auto result = std::make_shared<Result>();
    result->text = outcome.text;
    if (outcome.status == Status::reached) {
      result->status = Result::REACHED;
      handle.set_succeeded(result);
    } else if (outcome.status == Status::stopped) {
      result->status = Result::STOPPED;
      handle.set_canceled(result);
    } else {
      result->status = outcome.status == Status::refused ? Result::REFUSED : Result::FAILED;
      handle.set_aborted(result);
    }
  }

  void send(long number, double start, const std::vector<Point> &points) {
    Follow::Goal goal;
    goal.trajectory.header.stamp = rclcpp::Time(std::llround(start * 1e9), get_clock()->get_clock_type());
    goal.trajectory.joint_names = joints_;
    for (const Point &point : points) {
      auto &to = goal.trajectory.points.emplace_back();
      to.positions.assign(point.q.begin(), point.q.end());
      to.velocities.assign(point.dq.begin(), point.dq.end());
      to.accelerations.assign(point.ddq.begin(), point.ddq.end());
      to.time_from_start = rclcpp::Duration::from_seconds(point.time);
    }
    for (const std::string &joint : joints_) {
      auto &tolerance = goal.goal_tolerance.emplace_back();
      tolerance.name = joint;
      tolerance.position = goal_tolerance_;
    }
    goal.path_tolerance = goal.goal_tolerance;
    for (auto &tolerance : goal.path_tolerance) tolerance.position = path_tolerance_;
    goal.goal_time_tolerance = rclcpp::Duration::from_seconds(goal_time_tolerance_);
    rclcpp_action::Client<Follow>::SendGoalOptions options;
    options.goal_response_callback = [this, number](auto handle) {
      if (!handle) server_.answer(number, Answer::rejected, "goal rejected");
    };
    options.result_callback = [this, number](const auto &wrapped) {
      const bool done = wrapped.code == rclcpp_action::ResultCode::SUCCEEDED;
      const auto &result = *wrapped.result;
      server_.answer(
        number, done ? Answer::succeeded : Answer::aborted,
        "controller: error " + std::to_string(result.error_code) + " " + result.error_string);
    };
    controller_->async_send_goal(goal, options);
  }

  const std::vector<std::string> joints_ = declare_parameter(
    "joint_names",
    std::vector<std::string>(planner::joint_names, planner::joint_names + planner::joints));
  const double start_tolerance_ = declare_parameter<double>("start_tolerance", 0.005);  // rad
  const double rest_tolerance_ = declare_parameter<double>("rest_tolerance", 0.01);  // rad/s
  const double max_age_ = declare_parameter<double>("max_age", 0.1);  // s
  const double path_tolerance_ = declare_parameter<double>("path_tolerance", 0.05);  // rad
  const double goal_tolerance_ = declare_parameter<double>("goal_tolerance", 0.01);  // rad
  const double goal_time_tolerance_ = declare_parameter<double>("goal_time_tolerance", 0.5);  // s
  sensor_msgs::msg::JointState::ConstSharedPtr measured_;
  rclcpp_action::Client<Follow>::SharedPtr controller_ = rclcpp_action::create_client<Follow>(
    this, declare_parameter<std::string>(
            "controller", "joint_trajectory_controller/follow_joint_trajectory"));
  MotionServer server_{
    {[this] { return now().seconds(); },
     [this](long number, double start, const std::vector<Point> &points) { send(number, start, points); }},
    declare_parameter<double>("period", 0.004),
    declare_parameter<double>("lead", 0.05)};
  rclcpp::Subscription<sensor_msgs::msg::JointState>::SharedPtr states_;
  rclcpp_action::Server<PlanMotion>::SharedPtr actions_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<PlanMotionNode>());  // one thread: callbacks need no lock
  rclcpp::shutdown();
  return 0;
}
