function [pose, gap_um, point] = fpcal_fk(now, q)
% FPCAL_FK  Mirror pose and cavity length at joint values, of the calibrated chain.
%   [pose, gap_um, point] = fpcal_fk(now, q)
%   now     what fpcal track --flat wrote: load('now.mat') or jsondecode(fileread('now.json'))
%   q       joint values as files hold them, um and deg
%   pose    fX, 4 x 4: the mirror frame at the reflection point, in the fibre frame, um
%   gap_um  cavity length, from the fibre to the mirror
%   point   where the light meets the mirror, in the fibre frame, um
%   Calibrated joint travel, paper equation (4); cavity length, equations (28), (29).
  n = double(now.n_joints);
  q = double(q(:));
  if numel(q) ~= n
    error('fpcal:joints', 'fpcal_fk: expected %d joint values, found %d', n, numel(q));
  end
  tool = eye(4);
  for j = 1:n
    travel = q(j) * (1 + now.link_gain_ppm(j) * 1e-6);
    theta = now.link_theta_deg(j);
    r = now.link_r_um(j);
    if now.joint_revolute(j)
      theta = theta + travel;
      r = r + now.link_runout_cos_um(j) * cosd(travel) + now.link_runout_sin_um(j) * sind(travel);
    else
      r = r + travel;
    end
    tool = tool * turn_y(now.link_beta_deg(j)) * turn_x(now.link_alpha_deg(j)) * shift(now.link_d_um(j), 0, 0) ...
        * turn_z(theta) * shift(0, 0, r);
  end
  pose = now.fibre_in_world \ (tool * now.point_in_tool);
  mirror = now.fibre_in_world \ (tool * now.mirror_in_tool);
  normal = mirror(1:3, 3);
  if strcmp(now.opd, 'axis')
    if strcmp(now.optical_axis, 'z')
      along = [0; 0; 1];
    else
      along = [0; -1; 0];
    end
  else
    along = normal;
  end
  signed_um = (normal' * mirror(1:3, 4)) / (normal' * along);
  point = along * signed_um;
  gap_um = abs(signed_um);
end

function t = turn_x(a)
  t = [1 0 0 0; 0 cosd(a) -sind(a) 0; 0 sind(a) cosd(a) 0; 0 0 0 1];
end

function t = turn_y(a)
  t = [cosd(a) 0 sind(a) 0; 0 1 0 0; -sind(a) 0 cosd(a) 0; 0 0 0 1];
end

function t = turn_z(a)
  t = [cosd(a) -sind(a) 0 0; sind(a) cosd(a) 0 0; 0 0 1 0; 0 0 0 1];
end

function t = shift(x, y, z)
  t = eye(4);
  t(1:3, 4) = [x; y; z];
end
