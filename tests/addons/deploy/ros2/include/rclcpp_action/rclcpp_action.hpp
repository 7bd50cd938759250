// The part of rclcpp_action that the example uses, declared by hand for a compiler's check.
#pragma once

#include <array>
#include <functional>
#include <future>
#include <memory>
#include <string>

#include "rclcpp/rclcpp.hpp"

namespace rclcpp_action {

using GoalUUID = std::array<uint8_t, 16>;
enum class GoalResponse : int8_t { REJECT = 1, ACCEPT_AND_EXECUTE = 2, ACCEPT_AND_DEFER = 3 };
enum class CancelResponse : int8_t { REJECT = 1, ACCEPT = 2 };
enum class ResultCode : int8_t { UNKNOWN = 0, SUCCEEDED = 4, CANCELED = 5, ABORTED = 6 };

template <typename ActionT>
class ServerGoalHandle {
public:
  void set_aborted(typename ActionT::Result::SharedPtr result);
  void set_succeeded(typename ActionT::Result::SharedPtr result);
  void set_canceled(typename ActionT::Result::SharedPtr result);
  std::shared_ptr<const typename ActionT::Goal> get_goal() const;
  const GoalUUID &get_goal_id() const;
};

template <typename ActionT>
class Server {
public:
  using SharedPtr = std::shared_ptr<Server>;
  using GoalCallback =
    std::function<GoalResponse(const GoalUUID &, std::shared_ptr<const typename ActionT::Goal>)>;
  using CancelCallback = std::function<CancelResponse(std::shared_ptr<ServerGoalHandle<ActionT>>)>;
  using AcceptedCallback = std::function<void(std::shared_ptr<ServerGoalHandle<ActionT>>)>;
};

template <typename ActionT>
class ClientGoalHandle {
public:
  using SharedPtr = std::shared_ptr<ClientGoalHandle>;
  struct WrappedResult {
    GoalUUID goal_id;
    ResultCode code;
    typename ActionT::Result::SharedPtr result;
  };
};

template <typename ActionT>
class Client {
public:
  using SharedPtr = std::shared_ptr<Client>;
  using GoalHandle = ClientGoalHandle<ActionT>;
  struct SendGoalOptions {
    std::function<void(typename GoalHandle::SharedPtr)> goal_response_callback;
    std::function<void(const typename GoalHandle::WrappedResult &)> result_callback;
  };
  bool action_server_is_ready() const;
  std::shared_future<typename GoalHandle::SharedPtr> async_send_goal(
    const typename ActionT::Goal &goal, const SendGoalOptions &options = SendGoalOptions());
};

template <typename ActionT, typename NodeT>
typename Server<ActionT>::SharedPtr create_server(
  NodeT node, const std::string &name, typename Server<ActionT>::GoalCallback handle_goal,
  typename Server<ActionT>::CancelCallback handle_cancel,
  typename Server<ActionT>::AcceptedCallback handle_accepted);

template <typename ActionT, typename NodeT>
typename Client<ActionT>::SharedPtr create_client(NodeT node, const std::string &name);

}  // namespace rclcpp_action
