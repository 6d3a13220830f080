#!/bin/sh
# What app_robot.py runs on a robot, as root: a command, an app's name, and what the command takes.
# Status 3: refused, for the reason on stderr.
set -eu
command=$1 name=$2
shift 2
apps=/data/apps
compilers=/data/compilers
unit=flotilla-app@$name.service
system=/etc/systemd/system
wants=$system/multi-user.target.wants/$unit
statistics=/var/lib/flotilla-apps/$name/statistics.json
foreground=/run/systemd/system/$unit.d/foreground.conf

refuse() {
    echo "$*" >&2
    exit 3
}

# One command at a time changes an app; one that was cut off still comes to its end before another answers.
own_apps() {
    mkdir -p "$apps"
    exec 8<"$apps"
    flock -w 60 8 || refuse "another command has been changing its apps for a minute"
}

# Whether the app starts again when it has failed, as apps do that go on by themselves.
restarts() {
    [ "$1" = no ] || [ -e "$foreground" ] || return 0
    [ "$1" = yes ] || [ ! -e "$foreground" ] || return 0
    mkdir -p "${foreground%/*}"
    if [ "$1" = no ]; then
        printf '[Service]\nRestart=no\n' >"$foreground"
    else
        rm "$foreground"
    fi
    systemctl daemon-reload
}

# Refuse what is no robot for apps, or whose processor is not of the board's MACHINE, a pattern for uname's.
fits() {
    # shellcheck disable=SC2254 # a pattern
    case $(uname -m) in
    $1) ;;
    *) refuse "it is an $(uname -m), but its board in the inventory is not; nothing was changed" ;;
    esac
    [ -e /usr/lib/systemd/system/flotilla-app@.service ] || refuse "its image knows no apps; flash a new one"
}

# Names, modes and owners below a directory.
listed() {
    find "$1" -printf '%P %y %m %U %G\n' | sort
}

# Whether the version is there, as it is in a directory.
is_there() {
    [ "$(readlink "$apps/$name")" = ".$name@$version" ] || return 1
    [ "$(listed "$1")" = "$(listed "$apps/.$name@$version")" ] || return 1
    diff -rq --no-dereference "$1" "$apps/.$name@$version" >/dev/null 2>&1
}

# Run a program as the app will run: what it loads is the app's code, which must not run as root. It has no network, none of
# its processes is left, and when memory is short it ends first.
as_app() (
    echo 1000 >/proc/self/oom_score_adj
    exec unshare --net --pid --fork --kill-child timeout -k 5 60 \
        setpriv --reuid=app --regid=app --clear-groups --bounding-set=-all --inh-caps=-all --no-new-privs "$@"
)

# End with status 3 if a program does not find its libraries and functions, or ldd cannot check it. A static one needs none.
loads() {
    found=$({ as_app ldd -r "$part/$1" 2>&1 && echo checked || echo "ended with status $?"; } | tail -c 1M)
    case $found in
    *"not found"* | *"undefined symbol"*)
        printf '%s\n' "$found" | grep -e "not found" -e "undefined symbol" >&2
        refuse "$1 needs libraries or functions that are missing on the robot; nothing was changed"
        ;;
    checked | *"
checked" | *"not a dynamic executable"*) ;;
    *)
        printf '%s\n' "$found" >&2
        refuse "$1 cannot be checked on the robot by ldd; nothing was changed"
        ;;
    esac
}

# Take the app's files from standard input, and put them in the place of what is there once nothing can fail any more:
# VERSION of the files, KiB that must be free, PROGRAM or nothing.
receive() {
    version=$1 need=$2 program=$3
    part=$apps/.$name.part
    mkdir -p "$apps"
    rm -rf "$part"
    trap 'rm -rf "$part"' EXIT
    free=$(df --output=avail -k "$apps" | tail -n 1)
    [ "$free" -ge "$need" ] || refuse "/data has $((free)) KiB left, and the app needs $need KiB; remove something," \
        "such as another app (make deploy APP=... RUN=remove); nothing was changed"
    mkdir "$part"
    tar -x --no-same-owner -C "$part"
    for task in "$part/task.yml" "$part/safe.yml"; do
        [ ! -e "$task" ] || as_app flotilla-run --check --blocks "$part/blocks:/usr/lib/flotilla/blocks" "$task" ||
            refuse "its runtime refuses the app; nothing was changed"
    done
    [ -z "$program" ] || loads "$program"
    sync -f "$part"

    reload=
    diff -rq "$apps/$name/unit.d" "$part/unit.d" >/dev/null 2>&1 || reload=yes
    ln -sfn "$apps/$name/unit.d" "$system/$unit.d"
    systemctl stop "$unit"
    if ! is_there "$part"; then
        rm -rf "$apps/.$name@$version"
        mv "$part" "$apps/.$name@$version"
        ln -sfn ".$name@$version" "$apps/.$name.link"
        mv -T "$apps/.$name.link" "$apps/$name"
    fi
    sync -f "$apps"
    for old in "$apps/.$name@"*; do
        [ "$old" = "$apps/.$name@$version" ] || rm -rf "$old"
    done
    [ -z "$reload" ] || systemctl daemon-reload
}

# One build at a time; what an earlier one left that was cut off is removed.
own_compilers() {
    mkdir -p "$compilers"
    exec 9<"$compilers"
    flock -w 600 9 || refuse "another app has been compiling on it for ten minutes; nothing was changed"
    rm -rf "$compilers/work" "$compilers/part"
    trap 'rm -rf "$compilers/work" "$compilers/part"' EXIT
}

# Refuse when fewer than that many KiB are free, for a purpose.
room() {
    free=$(df --output=avail -k "$compilers" | tail -n 1)
    [ "$free" -ge "$1" ] || refuse "/data has $((free)) KiB left, and $2 needs $1 KiB; compile on the development" \
        "computer (without ON_ROBOT=1), or remove something, such as another app; nothing was deployed"
}

# Take the compiler from standard input: its SHA-256, KiB that must be free. Earlier ones are of no more use.
receive_compiler() {
    own_compilers
    rm -f "$compilers"/*.squashfs
    room "$2" "the compiler"
    cat >"$compilers/part"
    [ "$(sha256sum <"$compilers/part")" = "$1  -" ] || refuse "the compiler did not arrive whole; try again"
    sync "$compilers/part"
    mv "$compilers/part" "$compilers/$1.squashfs"
}

# In namespaces that end with the command, and with them the mounts: IMAGE, WORK, the command. As nobody; the robot's
# control goes before, and when memory is short it ends first.
# shellcheck disable=SC2016 # another shell's
enter_and_compile='
image=$1 work=$2
shift 2
root=$work/root
mount -o loop,ro,nosuid,nodev "$image" "$root"
mount --bind "$work/out" "$root/out"
mount --bind "$work/tmp" "$root/tmp"
mount -t proc proc "$root/proc"
mount -t tmpfs -o mode=755,nosuid tmpfs "$root/dev"
for device in null zero full random urandom; do
    : >"$root/dev/$device"
    mount --bind "/dev/$device" "$root/dev/$device"
done
echo 1000 >/proc/self/oom_score_adj
exec timeout 1800 nice -n 19 ionice -c 3 setpriv --no-new-privs chroot --userspec=65534:65534 "$root" "$@"
'

# Run a command of the compiler's root on files from standard input, which are /out; write them to standard output.
# The compiler's SHA-256, KiB that must be free, the command. Of what it reaches nothing is the robot's.
compile() {
    image=$compilers/$1.squashfs need=$2 work=$compilers/work status=0
    shift 2
    own_compilers
    room "$need" "compiling"
    [ -e /dev/loop-control ] || modprobe loop # robots make no device nodes of modules that are not loaded
    mkdir -p "$work/root" "$work/out" "$work/tmp"
    tar -x --no-same-owner -C "$work/out"
    chown -R 65534:65534 "$work/out" "$work/tmp"
    unshare --mount --pid --fork --kill-child --net --ipc \
        sh -euc "$enter_and_compile" compile "$image" "$work" "$@" </dev/null >&2 || status=$?
    [ "$status" = 0 ] || refuse "it does not compile (status $status)"
    tar -c -C "$work/out" .
}

there() {
    [ -e "$apps/$name" ] || refuse "there is no app $name; deploy it first"
}

forget() {
    rm -f "$statistics"
    systemctl reset-failed "$unit" 2>/dev/null || true
}

case $command in
receive | keep | start | run | rest | stop | status | remove | clear)
    own_apps
    ;;
esac

case $command in
fits)
    fits "$@"
    ;;
receive)
    receive "$@"
    ;;
has-compiler)
    [ ! -e "$compilers/$1.squashfs" ] || echo yes
    ;;
receive-compiler)
    receive_compiler "$@"
    ;;
compile)
    compile "$@"
    ;;
keep) # start it with the robot
    there
    mkdir -p "${wants%/*}"
    ln -sfn /usr/lib/systemd/system/flotilla-app@.service "$wants"
    systemctl daemon-reload
    sync -f "$system"
    ;;
start)
    there
    systemctl is-active -q "$unit" || forget
    restarts yes
    systemctl start "$unit" || {
        journalctl -q -n 10 -o cat -u "$unit" >&2
        systemctl stop "$unit"
        refuse "$name does not start"
    }
    ;;
run) # start it anew for as long as standard input lasts, which ends with the connection; write a cursor, then its log
    there
    systemctl stop "$unit"
    forget
    restarts no
    cursor=$(journalctl -q -n 1 -o cat --show-cursor | sed -n 's/^-- cursor: //p')
    echo "$cursor"
    exec 8<&-
    journalctl -q -f -o json --no-tail --after-cursor="$cursor" UNIT="$unit" + _SYSTEMD_UNIT="$unit" &
    trap 'systemctl stop "$unit"; kill $!' EXIT
    systemctl start --no-block "$unit"
    cat >/dev/null
    ;;
rest) # end it, and write its log from a cursor on
    systemctl stop "$unit"
    [ "$1" ] || exit 0 # it never began
    journalctl --sync
    journalctl -q -o json --after-cursor="$1" UNIT="$unit" + _SYSTEMD_UNIT="$unit"
    ;;
log)
    there
    exec journalctl -q -f -o cat -n 20 -u "$unit"
    ;;
stop)
    there
    systemctl stop "$unit"
    ;;
statistics)
    [ ! -e "$statistics" ] || as_app head -c 16M "$statistics" # a link leads no further than the app itself may read
    ;;
status)
    there
    systemctl show -p ActiveState -p SubState -p Result -p NRestarts -p MainPID -p ActiveEnterTimestamp "$unit"
    version=$(readlink "$apps/$name")
    echo "Version=${version#*@}"
    [ -L "$wants" ] && kept=yes || kept=no
    echo "Kept=$kept"
    ;;
remove | clear) # `clear`: what there is of it, if anything
    [ "$command" = clear ] || there
    systemctl stop "$unit"
    forget # a failed unit without files would stay, and fail what asks for those
    rm -rf "$wants" "$system/$unit.d" "${foreground%/*}" "${apps:?}/$name" "$apps/.$name@"* "$apps/.$name.part" "${statistics%/*}"
    systemctl daemon-reload
    sync -f "$apps"
    ;;
esac
