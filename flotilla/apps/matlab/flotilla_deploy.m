function flotilla_deploy(model, varargin)
%FLOTILLA_DEPLOY Bring the code that Embedded Coder generated of a model to a robot.
%   FLOTILLA_DEPLOY(MODEL, 'Robot', 3, 'Station', 'user@host') packs the build of MODEL (packNGo), sends it over SSH to
%   the station computer, which has Flotilla, and lets that make or renew the app and run it on the robot. Build the
%   model before (slbuild). Works in MATLAB for Windows and for Linux, with the OpenSSH client of either.
%
%   'Robot'        number of the robot in the inventory
%   'Station'      the station computer, as ssh takes it: host, user@host, or a Host of ~/.ssh/config
%   'Checkout'     Flotilla's directory there; default '~/flotilla'
%   'App'          the app's name; default: the model's, in small letters and with hyphens
%   'BuildDir'     folder with buildInfo.mat; default: that of the model (RTW.getBuildDir)
%   'SampleTimes'  in seconds, fastest first, where the code does not say them, such as [0.01 0.05]; for a new app
%   'Keep'         true: the app goes on and starts with the robot; default: it runs until Ctrl-C
%   'Deploy'       false: only import the code on the station computer; no 'Robot' is needed then
%
%   ssh must not have to ask: give the station computer your public key (ssh-copy-id), and connect to it once by hand.
%   docs/how-to/apps.md has the rest.

options = read_options(model, varargin);
remote = remote_command(options);
archive = pack(options);
clean = onCleanup(@() remove(archive));
check_ssh();
send(archive, options.Station);
run_there(remote, options);
end

function options = read_options(model, given)
is_text = @(value) ischar(value) || isa(value, 'string');
is_flag = @(value) isscalar(value) && (islogical(value) || isnumeric(value));
parser = inputParser();
parser.FunctionName = 'flotilla_deploy';
parser.addRequired('Model', is_text);
parser.addParameter('Robot', [], @(value) isnumeric(value) && isscalar(value) && value >= 1 && value == fix(value));
parser.addParameter('Station', '', is_text);
parser.addParameter('Checkout', '~/flotilla', is_text);
parser.addParameter('App', '', is_text);
parser.addParameter('BuildDir', '', is_text);
parser.addParameter('SampleTimes', [], @(value) isnumeric(value) && all(value(:) > 0));
parser.addParameter('Keep', false, is_flag);
parser.addParameter('Deploy', true, is_flag);
parser.parse(model, given{:});
options = parser.Results;
for name = {'Model', 'Station', 'Checkout', 'App', 'BuildDir'}
    options.(name{1}) = char(options.(name{1}));
end
if isempty(options.App)
    options.App = strrep(lower(options.Model), '_', '-');
end
% What goes to two shells, that of this computer and that of the station computer, has no character that one of them
% reads as another.
check(options.Model, '^[A-Za-z]\w*$', 'Model', 'the name of a model, such as hover_ctrl');
check(options.App, '^[a-z][a-z0-9-]{0,31}$', 'App', 'a small letter, then small letters, digits or hyphens');
check(options.Station, '^[A-Za-z0-9_][A-Za-z0-9_.-]*(@[A-Za-z0-9][A-Za-z0-9_.:-]*)?$', 'Station', ...
      'a host, such as user@station');
check(options.Checkout, '^(~/|/)?[A-Za-z0-9_][A-Za-z0-9_. /+-]*$', 'Checkout', ...
      'a directory of letters, digits, blanks and _.-+/, such as ~/flotilla');
if options.Deploy && isempty(options.Robot)
    error('flotilla:robot', 'Robot: is missing; say ''Robot'', 3, or ''Deploy'', false');
end
end

function check(value, pattern, name, remedy)
if isempty(regexp(value, pattern, 'once'))
    error('flotilla:value', '%s: ''%s'' is not allowed; give %s', name, value, remedy);
end
end

function archive = pack(options)
% The ZIP file, in a folder of its own.
folder = options.BuildDir;
if isempty(folder)
    folders = RTW.getBuildDir(options.Model);
    folder = folders.BuildDirectory;
end
file = fullfile(folder, 'buildInfo.mat');
if exist(file, 'file') ~= 2
    error('flotilla:build', '%s is missing; build the model first: slbuild(''%s'')', file, options.Model);
end
loaded = load(file);
if ~isfield(loaded, 'buildInfo')
    error('flotilla:build', '%s has no buildInfo; build the model again: slbuild(''%s'')', file, options.Model);
end
folder = tempname();
mkdir(folder);
archive = fullfile(folder, [file_name(options) '.zip']);
packNGo(loaded.buildInfo, 'packType', 'flat', 'fileName', archive);
if exist(archive, 'file') ~= 2
    remove(archive);
    error('flotilla:pack', '%s: packNGo did not write it; look at what it said', archive);
end
end

function name = file_name(options)
name = ['flotilla-import-' options.App];
end

function remove(archive)
folder = fileparts(archive);
if exist(archive, 'file') == 2
    delete(archive);
end
if exist(folder, 'dir') == 7
    rmdir(folder);
end
end

function command = remote_command(options)
% Quoted for the station computer's shell, by apostrophes alone: the other shell's are quotation marks on Windows.
place = options.Checkout;
if strncmp(place, '~/', 2)
    place = ['~/''' place(3:end) ''''];
else
    place = ['''' place ''''];
end
archive = ['build/' file_name(options) '.zip'];
made = sprintf('make import-model ZIP=%s NAME=%s MODEL=%s', archive, options.App, options.Model);
if ~isempty(options.SampleTimes)
    times = sprintf('%.9g,', options.SampleTimes);
    made = [made ' SAMPLE_TIMES=' times(1:end - 1)];
end
steps = {['cd ' place], 'mkdir -p build', ['mv ~/' file_name(options) '.zip ' archive], made, ['rm ' archive]};
if options.Deploy
    keep = '';
    if options.Keep
        keep = ' KEEP=1';
    end
    steps{end + 1} = sprintf('make deploy ROBOT=%d APP=apps/%s%s', options.Robot, options.App, keep);
end
command = strjoin(steps, ' && ');
end

function text = quoted(text)
% For the shell of this computer. No character in it needs more: see read_options.
if ispc()
    text = ['"' text '"'];
else
    text = ['''' strrep(text, '''', '''\''''') ''''];
end
end

function status = call(program, arguments)
% MATLAB for Linux puts its own libraries before the system's, which the system's ssh does not start with.
if ispc()
    prefix = '';
else
    prefix = 'env -u LD_LIBRARY_PATH ';
end
status = system([prefix program ' ' arguments]);
end

function check_ssh()
if call('ssh', '-V') == 0
    return
end
if ispc()
    remedy = 'add Windows'' optional feature OpenSSH Client';
else
    remedy = 'install openssh-client';
end
error('flotilla:ssh', 'ssh does not start; %s', remedy);
end

function send(archive, station)
% By its name alone, from its folder: scp takes what is before a colon, as in C:\, for a computer.
[folder, name, suffix] = fileparts(archive);
before = cd(folder);
back = onCleanup(@() cd(before));
status = call('scp', sprintf('-q -o BatchMode=yes %s %s', quoted([name suffix]), quoted([station ':'])));
if status ~= 0
    error('flotilla:send', ['%s: scp ended with %d; connect once by hand (ssh %s), and give it your public key ' ...
                            '(ssh-copy-id, or append it to ~/.ssh/authorized_keys there)'], station, status, station);
end
end

function run_there(remote, options)
status = call('ssh', sprintf('-o BatchMode=yes %s %s', quoted(options.Station), quoted(remote)));
if status == 255
    error('flotilla:connection', '%s: the connection was lost; look at what the app does: make deploy RUN=status', ...
          options.Station);
elseif status ~= 0
    error('flotilla:station', ['%s: ended with %d; what is above says why. ''Checkout'' (%s) has to be the directory ' ...
                               'of Flotilla there'], options.Station, status, options.Checkout);
end
end
