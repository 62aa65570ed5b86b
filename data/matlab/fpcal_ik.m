function q = fpcal_ik(now, pose, near)
% FPCAL_IK  Joint values at which the mirror takes a pose, with the current best estimate.
%   q = fpcal_ik(now, pose, near)
%   now   what fpcal track --flat wrote: load('now.mat') or jsondecode(fileread('now.json'))
%   pose  fX, 4 x 4: the mirror frame at the reflection point, in the fibre frame, um; now.aligned_pose is where tasks
%         start. A pose [shift_um; turn_deg], 6 x 1, is taken relative to that: along X, Y, Z of the fibre frame, and
%         about X, then Y, then Z through the reflection point.
%   near  joint values to start from, um and deg: where the robot stands (default: zero)
%   q     joint values, n x 1, um and deg. Where the estimate knows error motions (tables motions_q1, ...) and that
%         gains, the joint along the beam makes up for them; set now.compensation to 0 for the geometry alone.
%   An estimate that is not to be used or is out of date, a pose out of reach and a joint beyond its limits are errors:
%   nothing is clipped. Read the file again before each move; it is replaced in one step.
  n = double(now.n_joints);
  if ~now.usable
    error('fpcal:unusable', 'fpcal_ik: the estimate is not to be used: %s', now.reasons);
  end
  if ~isempty(now.valid_until_unix_s) && ~isnan(now.valid_until_unix_s) && clock_s() > now.valid_until_unix_s
    error('fpcal:expired', 'fpcal_ik: the estimate was valid until %s', now.valid_until_utc);
  end
  if n ~= 6
    error('fpcal:joints', 'fpcal_ik: the cell has %d joints, expected 6; see fpcal control for fewer', n);
  end
  if nargin < 3
    near = zeros(n, 1);
  end
  if numel(pose) == 6
    pose = relative(now, double(pose(:)));
  end
  if any(size(pose) ~= 4) || any(~isfinite(pose(:))) || norm(pose(1:3, 1:3)' * pose(1:3, 1:3) - eye(3)) > 1e-6
    error('fpcal:pose', 'fpcal_ik: expected a 4 x 4 pose of finite numbers with an orthonormal rotation');
  end
  near = double(near(:));
  q = solved(now, pose, near);
  if isfield(now, 'compensation') && now.compensation
    q = made_up(now, solved(now, now.aligned_pose, zeros(n, 1)), near, q);
  end
  for j = 1:n
    low = now.joint_low(j);
    high = now.joint_high(j);
    if (~isnan(low) && q(j) < low) || (~isnan(high) && q(j) > high)
      error('fpcal:limits', 'fpcal_ik: q%d at %.6g, expected %.6g to %.6g', j, q(j), low, high);
    end
  end
end

function q = solved(now, pose, near)
  % Steps of um and deg that turn and shift alike; derivatives by central differences are exact enough, since the
  % steps shrink with what is left.
  lever = 1e3;
  q = near;
  n = numel(near);
  left = miss(now, q, pose, lever);
  for round = 1:50
    if norm(left) < 1e-10
      break
    end
    jacobian = zeros(6, n);
    for j = 1:n
      h = zeros(n, 1);
      h(j) = 1e-2;
      jacobian(:, j) = (miss(now, q + h, pose, lever) - miss(now, q - h, pose, lever)) / 2e-2;
    end
    step = -(jacobian \ left);
    scale = 1;
    while scale > 1e-4
      after = miss(now, q + scale * step, pose, lever);
      if norm(after) < norm(left)
        break
      end
      scale = scale / 2;
    end
    if norm(after) >= norm(left)
      break
    end
    q = q + scale * step;
    left = after;
  end
  if norm(left) > 1e-6
    error('fpcal:reach', 'fpcal_ik: the pose is out of reach from here: %.3g um are left', norm(left));
  end
end

function q = made_up(now, start, before, plain)
  % As compensated_path of the package, for one point; inside here joints are in um and rad.
  n = numel(plain);
  unit = ones(n, 1);
  unit(logical(now.joint_revolute(:))) = pi / 180;
  poses = [start(:), before(:), plain(:)] .* unit;
  low = now.joint_low(:) .* unit;
  high = now.joint_high(:) .* unit;
  [error_um, new, drive, felt] = motions(now, poses);
  slopes = abs(drive);
  slopes(logical(now.joint_revolute(:))) = 0;
  [slope, joint] = max(slopes);
  q = plain(:);
  if slope < 0.5 || error_um ^ 2 < 0.2 ^ 2 * sum(felt .^ 2)
    return
  end
  left = error_um;
  again = new;
  moved = poses;
  for round = 1:3
    moved(joint, 3) = min(max(poses(joint, 3) - left / drive(joint), low(joint)), high(joint));
    [left, again] = motions(now, moved);
  end
  added = (moved(joint, 3) - poses(joint, 3)) * drive(joint);
  if (left + added) ^ 2 + again < error_um ^ 2 + new
    q(joint) = moved(joint, 3) / unit(joint);
  end
end

function [error_um, new, drive, felt] = motions(now, poses)
  % What the known error motions add to the cavity length at the last of three poses, beyond the first; the mean square
  % of return errors on the way; the slope of each joint; what each weight of the stated size would add.
  n = size(poses, 1);
  steps = sign(diff(poses, 1, 2));
  side = steps(:, 2);
  side(side == 0) = steps(side == 0, 1);
  [at_start, ~] = felt_at(now, poses(:, 1), zeros(n, 1));
  [~, before] = felt_at(now, poses(:, 2), zeros(n, 1));
  [at_end, drive, means] = felt_at(now, poses(:, 3), side);
  felt = at_end - at_start;
  error_um = felt' * means;
  returned = [before, drive] .* now.return_sd_um_rad(:);
  moving = any(steps ~= 0, 2);
  new = sum(sum(returned(moving, :) .^ 2)) / 2;
end

function [felt, drive, means] = felt_at(now, q, side)
  % Of each weight of the stated size, in um; the slopes of the joints; the posterior means of the weights.
  n = numel(q);
  turn = eye(3);
  at = zeros(3, 1);
  base = cell(n, 1);
  pivot = cell(n, 1);
  carried = cell(n, 1);
  for j = 1:n
    b = now.link_beta_deg(j);
    a = now.link_alpha_deg(j);
    turn = turn * [cosd(b) 0 sind(b); 0 1 0; -sind(b) 0 cosd(b)] * [1 0 0; 0 cosd(a) -sind(a); 0 sind(a) cosd(a)];
    at = at + now.link_d_um(j) * turn(:, 1);
    base{j} = turn;
    pivot{j} = at;
    travel = q(j) * (1 + now.link_gain_ppm(j) * 1e-6);
    angle = now.link_theta_deg(j) * pi / 180;
    along = now.link_r_um(j);
    if now.joint_revolute(j)
      angle = angle + travel;
      along = along + now.link_runout_cos_um(j) * cos(travel) + now.link_runout_sin_um(j) * sin(travel);
    else
      along = along + travel;
    end
    at = at + along * turn(:, 3);
    carried{j} = at;
    turn = turn * [cos(angle) -sin(angle) 0; sin(angle) cos(angle) 0; 0 0 1];
  end
  mirror = [turn, at; 0 0 0 1] * now.mirror_in_tool;
  normal = mirror(1:3, 3);
  fibre = now.fibre_in_world(1:3, 4);
  distance = (mirror(1:3, 4) - fibre)' * normal;
  if strcmp(now.opd, 'axis')
    if strcmp(now.optical_axis, 'z')
      beam = now.fibre_in_world(1:3, 3);
    else
      beam = -now.fibre_in_world(1:3, 2);
    end
    inverse = 1 / (normal' * beam);
    turned = cross(normal, beam) * distance * inverse;
  else
    inverse = sign(distance);
    turned = zeros(3, 1);
  end
  drive = zeros(n, 1);
  parts = cell(n, 1);
  mean_parts = cell(n, 1);
  for j = 1:n
    axes_in_world = base{j} * now.(sprintf('motion_axes_q%d', j));
    moved = axes_in_world' * normal * inverse;
    arm = base{j} * now.motion_lever_um(j, :)';
    tilts = axes_in_world' * (cross(normal, carried{j} - arm - fibre) - turned) * inverse;
    if now.joint_revolute(j)
      tilts(1) = axes_in_world(:, 1)' * (cross(normal, pivot{j} - fibre) - turned) * inverse;
      drive(j) = tilts(1);
    else
      drive(j) = moved(1);
    end
    response = [moved; tilts];
    table = now.(sprintf('motions_q%d', j));
    if isempty(table)
      table = zeros(0, 4);
    end
    column = zeros(size(table, 1), 1);
    for k = 1:size(table, 1)
      kind = table(k, 1);
      order = table(k, 2);
      c = cos(q(j));
      s = sin(q(j));
      if kind == 9
        value = drive(j) * side(j);
      elseif kind == 8
        value = drive(j) * wave(order, 2 * pi * q(j) / now.encoder_period_um_rad(j));
      elseif kind == 7 && order > 0
        value = c * response(2) - s * response(3);
      elseif kind == 7
        value = s * response(2) + c * response(3);
      elseif now.joint_low(j) > -1e11 && now.joint_high(j) < 1e11
        unit = 1;
        if now.joint_revolute(j)
          unit = pi / 180;
        end
        low = now.joint_low(j) * unit;
        high = now.joint_high(j) * unit;
        value = response(kind) * legendre_of(order, (2 * q(j) - low - high) / (high - low));
      else
        value = response(kind) * wave(order, abs(order) * q(j));
      end
      column(k) = table(k, 3) * value;
    end
    parts{j} = column;
    mean_parts{j} = table(:, 4);
  end
  felt = vertcat(parts{:});
  means = vertcat(mean_parts{:});
end

function value = wave(order, angle)
  if order > 0
    value = cos(angle);
  else
    value = sin(angle);
  end
end

function value = legendre_of(order, x)
  before = 1;
  value = x;
  for k = 1:order - 1
    after = ((2 * k + 1) * x * value - k * before) / (k + 1);
    before = value;
    value = after;
  end
end

function left = miss(now, q, pose, lever)
  here = fpcal_fk(now, q);
  turn = pose(1:3, 1:3)' * here(1:3, 1:3);
  axis = [turn(3, 2) - turn(2, 3); turn(1, 3) - turn(3, 1); turn(2, 1) - turn(1, 2)] / 2;
  left = [here(1:3, 4) - pose(1:3, 4); lever * axis];
end

function pose = relative(now, offset)
  a = offset(4);
  b = offset(5);
  c = offset(6);
  x = [1 0 0; 0 cosd(a) -sind(a); 0 sind(a) cosd(a)];
  y = [cosd(b) 0 sind(b); 0 1 0; -sind(b) 0 cosd(b)];
  z = [cosd(c) -sind(c) 0; sind(c) cosd(c) 0; 0 0 1];
  pose = now.aligned_pose;
  pose(1:3, 1:3) = z * y * x * pose(1:3, 1:3);
  pose(1:3, 4) = pose(1:3, 4) + offset(1:3);
end

function s = clock_s()
  if exist('OCTAVE_VERSION', 'builtin')
    s = time();
  else
    s = posixtime(datetime('now', 'TimeZone', 'UTC'));
  end
end
