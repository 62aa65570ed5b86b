function answer = fpcal_client(url, what, varargin)
% FPCAL_CLIENT  Ask fpcal serve, from MATLAB or Octave.
%   now = fpcal_client(url, 'estimate')            flat estimate, as fpcal_ik and fpcal_fk take it
%   way = fpcal_client(url, 'joints', poses)       poses n x 6: um and deg from the aligned pose, as in a path CSV
%   way = fpcal_client(url, 'joints', poses, q_now)  from where the robot stands, um and deg
%   way = fpcal_client(url, 'joints', request)     request a struct: task, radius_um, points, poses, q_now, despite, ..
%   told = fpcal_client(url, 'decision' | 'health')
%   told = fpcal_client(url, 'suggest', n)
%   done = fpcal_client(url, 'sweeps', text)       text of a CSV of sweeps, as fileread gives it
%   url   'http://127.0.0.1:8765'; a token is taken from the environment variable FPCAL_TOKEN
%   way.q is n x 6, um and deg, NaN where way.status is not 'ok'; way.predicted_sd_nm is n x 1, NaN where not known.
%   Errors have the identifier fpcal:KIND: refused, request, state, held, busy, token.
  token = getenv('FPCAL_TOKEN');
  options = weboptions('Timeout', 120, 'ContentType', 'text');
  if ~isempty(token)
    options.HeaderFields = {'Authorization', ['Bearer ' token]};
  end
  % Neither program shows the body of an error, so that it is asked for with status 200.
  query = '?always_200=1';
  switch what
    case 'estimate'
      text = webread([url '/estimate' query '&flat=true'], options);
    case {'decision', 'health'}
      text = webread([url '/' what query], options);
    case 'suggest'
      text = webread(sprintf('%s/suggest%s&n=%d', url, query, varargin{1}), options);
    case 'joints'
      request = varargin{1};
      if ~isstruct(request)
        request = struct('poses', request);
      end
      if numel(varargin) > 1
        request.q_now = varargin{2};
      end
      text = webwrite([url '/joints' query], 'request', jsonencode(listed(request)), options);
    case 'sweeps'
      text = webwrite([url '/sweeps' query], 'request', varargin{1}, options);
    otherwise
      error('fpcal:request', 'fpcal_client: expected estimate, joints, decision, suggest, sweeps or health');
  end
  answer = jsondecode(text);
  if isfield(answer, 'error')
    error(['fpcal:' answer.error.kind], '%s', answer.error.message);
  end
  if strcmp(what, 'joints')
    answer.q = numbers(answer.q, numel(answer.joint_names));
    answer.predicted_sd_nm = numbers(answer.predicted_sd_nm, 1);
  end
end

function request = listed(request)
  % One row is a list of one, and so is a single number.
  if isfield(request, 'poses') && isnumeric(request.poses)
    request.poses = num2cell(double(request.poses), 2);
  end
  if isfield(request, 'q_now')
    request.q_now = num2cell(double(request.q_now(:)'));
  end
end

function table = numbers(found, width)
  % What has no number is NaN.
  if iscell(found)
    empty = cellfun(@isempty, found);
    found(empty) = {NaN(width, 1)};
    table = reshape(cell2mat(cellfun(@(row) double(row(:)), found(:)', 'UniformOutput', false)), width, [])';
  elseif isempty(found)
    table = NaN(0, width);
  else
    table = reshape(double(found), [], width);
  end
end
