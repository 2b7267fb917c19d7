"""The program that runs on the robot: URScript, which takes targets from ur_rtde's registers.

It takes the place of ur_rtde's own. It knows only the commands that a slice needs, and it ends at a
target that jumps, whatever wrote it into the registers. After a lost connection ur_rtde uploads a
program again and again: it is given one that does nothing.
"""

import socket
from pathlib import Path

__all__ = ["NOTHING", "control_script", "upload"]

SCRIPT_PORT = 30003
CYCLE = 0.002
SLACK = 1.1
"""How much faster than allowed targets may come: the robot's cycles are not the client's."""
PATIENCE = 2.0
"""How long the robot may take to accept a connection, s."""

_SCRIPT = """\
def rtde_control():
  # RTDE Control script - Main loop, by sliceit_drake.
  global most_in_a_step = {step:.9g}
  global most_in_a_cycle = {cycle:.9g}
  global most_move_speed = {speed:.9g}
  global servoing = False
  global servo_q = [0, 0, 0, 0, 0, 0]
  global servo_lookahead = 0.1
  global servo_gain = 300
  global budget = 0
  global move_q = [0, 0, 0, 0, 0, 0]
  global move_v = 0
  global move_a = 0
  global servo_thrd = 0
  global move_thrd = 0

  thread servo_thread():
    while (True):
      enter_critical
      q = servo_q
      lookahead = servo_lookahead
      g = servo_gain
      exit_critical
      servoj(q, t=0.002, lookahead_time=lookahead, gain=g)
    end
  end

  thread move_thread():
    movej(move_q, a=move_a, v=move_v)
  end

  def six():
    q = [0, 0, 0, 0, 0, 0]
    k = 0
    while k < 6:
      q[k] = read_input_float_register(k)
      k = k + 1
    end
    return q
  end

  def stop_threads():
    enter_critical
    if servo_thrd != 0:
      kill servo_thrd
      servo_thrd = 0
    end
    if move_thrd != 0:
      kill move_thrd
      move_thrd = 0
    end
    servoing = False
    exit_critical
  end

  # A target farther from the last than the arm may go since then ends the program.
  def check_step(q):
    budget = budget + most_in_a_cycle
    if budget > most_in_a_step:
      budget = most_in_a_step
    end
    k = 0
    largest = 0
    while k < 6:
      step = norm(q[k] - servo_q[k])
      # Written so that what is no number does not pass.
      if not (step <= budget):
        stop_threads()
        stopj(10.0)
        textmsg("sliceit_drake: a target jumps by ", step)
        halt
      end
      if step > largest:
        largest = step
      end
      k = k + 1
    end
    budget = budget - largest
  end

  def process(cmd):
    if cmd == 1:
      stop_threads()
      move_q = six()
      move_v = read_input_float_register(6)
      move_a = read_input_float_register(7)
      # Written so that what is no number does not pass.
      if not (move_v <= most_move_speed):
        textmsg("sliceit_drake: a motion is too fast, in rad/s: ", move_v)
        halt
      end
      move_thrd = run move_thread()
    elif cmd == 8:
      zero_ftsensor()
    elif cmd == 11:
      q = six()
      if not servoing:
        servo_q = get_target_joint_positions()
        budget = most_in_a_cycle
      end
      check_step(q)
      enter_critical
      servo_q = q
      servo_lookahead = read_input_float_register(9)
      servo_gain = read_input_float_register(10)
      exit_critical
      if not servoing:
        servoing = True
        servo_thrd = run servo_thread()
      end
    elif cmd == 16:
      stop_threads()
      stopj(read_input_float_register(0))
    elif cmd == 34:
      stop_threads()
      stopj(read_input_float_register(0))
    elif cmd == 35:
      rtde_set_watchdog("input_int_register_0", read_input_float_register(0), "stop")
    elif cmd == 37:
      if is_within_safety_limits(six()):
        write_output_integer_register(1, 1)
      else:
        write_output_integer_register(1, 0)
      end
    elif cmd == 40:
      tcp = get_tcp_offset()
      k = 0
      while k < 6:
        write_output_float_register(k, tcp[k])
        k = k + 1
      end
    elif cmd != 255:
      textmsg("sliceit_drake: there is no command ", cmd)
      stop_threads()
      stopj(10.0)
      halt
    end
  end

  running = True
  executing = False
  write_output_integer_register(0, 1)
  while running:
    cmd = read_input_integer_register(0)
    if cmd == 11:
      process(cmd)
      write_output_integer_register(0, 1)
    elif cmd == 0:
      executing = False
      write_output_integer_register(0, 1)
    elif cmd == 255:
      running = False
    elif not executing:
      process(cmd)
      write_output_integer_register(0, 2)
      executing = True
    end
    sync()
  end
  stop_threads()
  stopj(10.0)
end
"""


NOTHING = Path(__file__).with_name("nothing.script")
"""File of a program that ends at once, in the place of any that runs."""


def control_script(joint_step: float, joint_speed: float) -> str:
    """The text of the program.

    Args:
        joint_step: Most that a joint's target may change at once, however long nothing came, rad.
        joint_speed: Greatest speed of a joint, rad/s.
    """
    cycle = SLACK * CYCLE * joint_speed
    return _SCRIPT.format(step=joint_step, cycle=cycle, speed=joint_speed)


def upload(host: str, text: str) -> socket.socket:
    """Sends a program to a robot, which starts it if it is in remote control.

    Returns:
        The connection, to be closed when all is over: what the robot sends on it is not read, and a
        connection that is closed so could lose the program.

    Raises:
        OSError: The robot does not take it.
    """
    connection = socket.create_connection((host, SCRIPT_PORT), PATIENCE)
    connection.sendall(text.encode("ascii"))
    return connection
