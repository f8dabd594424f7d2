/* Run a policy on a robot in C99: `python -m ce_gym export POLICY --out policy.h`, then cc -O2 robot_loop.c -lm.
 *
 * Reads the names of the robot's joints in one line, then a measurement in each line: time [s], quaternion w x y z
 * (body to world), angular velocity in the base frame [rad/s], command, joint positions and velocities. Writes joint
 * targets [rad] in the robot's order of joints. On a robot, call `order_joints` and `step` from the driver instead. */
#include <stdio.h>
#include <string.h>
#include "policy.h"

#define MAX_JOINTS 128

struct measurement { double stamp; float quaternion[4], gyro[3], command[3], positions[MAX_JOINTS], velocities[MAX_JOINTS]; };

static struct {
  int order[POLICY_JOINTS];  /* place of each of the policy's joints among the robot's */
  long steps, rate, clipped, saturated;  /* number of steps, and of steps with a violation */
  double stamp;
  float action[POLICY_ACTIONS], history[POLICY_HISTORY * POLICY_FRAME];
} loop;

/* Find the policy's joints by name; return 0, or -1 if one is missing. */
static int order_joints(char *const *names, int n) {
  for (int i = 0; i < POLICY_JOINTS; ++i) {
    loop.order[i] = -1;
    for (int j = 0; j < n; ++j)
      if (!strcmp(names[j], policy_joint_names[i])) loop.order[i] = j;
    if (loop.order[i] < 0) return fprintf(stderr, "the robot lacks joint %s\n", policy_joint_names[i]), -1;
  }
  return 0;
}

/* Write joint targets [rad] for a measurement; return -1 if the policy needs a number that is not measured. */
static int step(const struct measurement *m, float *targets) {
  const float w = m->quaternion[0], x = m->quaternion[1], y = m->quaternion[2], z = m->quaternion[3];
  const double phase = 6.283185307179586 * (double)loop.steps * (double)POLICY_CONTROL_DT / (double)POLICY_GAIT_PERIOD;
  float q[7 + POLICY_JOINTS] = {NAN, NAN, NAN, w, x, y, z}, v[6 + POLICY_JOINTS], command[3], out[POLICY_ACTIONS];
  const float gravity[3] = {-2 * (x * z - w * y), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1};
  const float gait[2] = {(float)sin(phase), (float)cos(phase)};
  const float *const sources[] = {q, v, command, loop.action, gravity, gait};
  float *const frame = loop.history;

  for (int i = 0; i < 3; ++i) {
    v[i] = m->gyro[i], v[3 + i] = NAN; /* the base's velocity is not measured */
    command[i] = fmaxf(policy_command_low[i], fminf(policy_command_high[i], m->command[i]));
  }
  for (int i = 0; i < POLICY_JOINTS; ++i) {
    q[7 + i] = m->positions[loop.order[i]];
    v[6 + i] = m->velocities[loop.order[i]];
  }
  memmove(frame + POLICY_FRAME, frame, sizeof(float) * POLICY_FRAME * (POLICY_HISTORY - 1));
  for (int i = 0; i < POLICY_FRAME; ++i) {
    const float seen = policy_offset[i] + policy_scale[i] * sources[policy_of[i]][policy_row[i]];
    if (!isfinite(seen)) return -1;
    frame[i] = fmaxf(-POLICY_OBSERVATION_BOUND, fminf(POLICY_OBSERVATION_BOUND, seen));
  }
  for (int k = 1; loop.steps == 0 && k < POLICY_HISTORY; ++k)
    memcpy(frame + k * POLICY_FRAME, frame, sizeof(float) * POLICY_FRAME);
  policy_act(loop.history, out);

  int clipped = 0, saturated = 0;
  float target[POLICY_JOINTS];
  memcpy(target, policy_default_joint_pos, sizeof target);
  for (int i = 0; i < POLICY_ACTIONS; ++i) {
    loop.action[i] = out[i];
    target[policy_action_joint[i]] += policy_action_scale[i] * out[i];
    clipped |= fabsf(out[i]) >= 1.0f;
  }
  for (int i = 0; i < POLICY_JOINTS; ++i) {
    const float torque = policy_joint_stiffness[i] * (target[i] - q[7 + i]) - policy_joint_damping[i] * v[6 + i];
    saturated |= fabsf(torque) > policy_torque_limits[i];
    targets[loop.order[i]] = target[i];
  }
  loop.rate += loop.steps && fabs(m->stamp - loop.stamp - (double)POLICY_CONTROL_DT) > 0.1 * (double)POLICY_CONTROL_DT;
  loop.clipped += clipped, loop.saturated += saturated, loop.stamp = m->stamp, ++loop.steps;
  return 0;
}

static int read_floats(float *x, int n) {
  for (int i = 0; i < n; ++i)
    if (scanf("%f", x + i) != 1) return 0;
  return 1;
}

int main(void) {
  static char line[1 << 16], *names[MAX_JOINTS];
  static struct measurement m;
  float targets[MAX_JOINTS];
  int n = 0;
  if (!fgets(line, sizeof line, stdin)) return 1;
  for (char *name = strtok(line, " \n"); name && n < MAX_JOINTS; name = strtok(NULL, " \n")) names[n++] = name;
  for (int i = 0; i < n; ++i) targets[i] = NAN; /* for joints that the policy does not know */
  if (order_joints(names, n)) return 1;
  while (scanf("%lf", &m.stamp) == 1 && read_floats(m.quaternion, 4) && read_floats(m.gyro, 3) &&
         read_floats(m.command, 3) && read_floats(m.positions, n) && read_floats(m.velocities, n)) {
    if (step(&m, targets)) return fprintf(stderr, "the policy observes a number that is not measured\n"), 1;
    for (int i = 0; i < n; ++i) printf("%.9g%c", (double)targets[i], i + 1 < n ? ' ' : '\n');
    fflush(stdout);
  }
  fprintf(stderr, "steps %ld, rate %ld, clipped %ld, saturated %ld\n", loop.steps, loop.rate, loop.clipped, loop.saturated);
  return 0;
}
