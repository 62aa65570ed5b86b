function q = fpcal_ik(now, pose, near)
% FPCAL_IK  Joint values at which the mirror takes a pose, with the current best estimate.
%   q = fpcal_ik(now, pose, near)
%   now   what fpcal track --flat wrote: load('now.mat') or jsondecode(fileread('now.json'))
%   pose  fX, 4 x 4: the mirror frame at the reflection point, in the fibre frame, um; now.aligned_pose is where tasks
%         start. A pose [shift_um; turn_deg], 6 x 1, is taken relative to that: along X, Y, Z of the fibre frame, and
%         about X, then Y, then Z through the reflection point.
%   near  joint values to start from, um and deg: where the robot stands (default: zero)
%   q     joint values, n x 1, um and deg
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
  % Steps of um and deg that turn and shift alike; derivatives by central differences are exact enough, since the
  % steps shrink with what is left.
  lever = 1e3;
  q = double(near(:));
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
  for j = 1:n
    low = now.joint_low(j);
    high = now.joint_high(j);
    if (~isnan(low) && q(j) < low) || (~isnan(high) && q(j) > high)
      error('fpcal:limits', 'fpcal_ik: q%d at %.6g, expected %.6g to %.6g', j, q(j), low, high);
    end
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
