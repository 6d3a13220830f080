#!/bin/sh
# What app_robot.py runs on a robot, as root: a command, an app's name, and what the command takes.
# Status 3: refused, for the reason on stderr.
set -eu
command=$1 name=$2
shift 2
apps=/data/apps
unit=flotilla-app@$name.service
system=/etc/systemd/system
wants=$system/multi-user.target.wants/$unit
statistics=/var/lib/flotilla-apps/$name/statistics.json

refuse() {
    echo "$*" >&2
    exit 3
}

# Take the app's files from standard input, and put them in the place of what is there once nothing can fail any more:
# VERSION of the files, the board's MACHINE as a pattern for uname's, KiB that must be free, PROGRAM or nothing.
receive() {
    version=$1 machine=$2 need=$3 program=$4
    part=$apps/.$name.part
    # shellcheck disable=SC2254 # a pattern
    case $(uname -m) in
    $machine) ;;
    *) refuse "it is an $(uname -m), but its board in the inventory is not; nothing was changed" ;;
    esac
    [ -e /usr/lib/systemd/system/flotilla-app@.service ] || refuse "its image knows no apps; flash a new one"
    mkdir -p "$apps"
    rm -rf "$part"
    trap 'rm -rf "$part"' EXIT
    free=$(df --output=avail -k "$apps" | tail -n 1)
    [ "$free" -ge "$need" ] || refuse "/data has $((free)) KiB left, and the app needs $need KiB; remove something," \
        "such as another app (make deploy APP=... RUN=remove); nothing was changed"
    mkdir "$part"
    tar -x --no-same-owner -C "$part"
    for task in "$part/task.yml" "$part/safe.yml"; do
        [ ! -e "$task" ] || flotilla-run --check --blocks "$part/blocks:/usr/lib/flotilla/blocks" "$task" ||
            refuse "its runtime refuses the app; nothing was changed"
    done
    if [ "$program" ]; then
        ! ldd "$part/$program" | grep "not found" >&2 ||
            refuse "$program needs libraries that the robot lacks; nothing was changed"
    fi
    sync -f "$part"

    reload=
    diff -rq "$apps/$name/unit.d" "$part/unit.d" >/dev/null 2>&1 || reload=yes
    ln -sfn "$apps/$name/unit.d" "$system/$unit.d"
    systemctl stop "$unit"
    if [ "$(readlink "$apps/$name")" != ".$name@$version" ]; then
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

there() {
    [ -e "$apps/$name" ] || refuse "there is no app $name; deploy it first"
}

forget() {
    rm -f "$statistics"
    systemctl reset-failed "$unit" 2>/dev/null || true
}

case $command in
receive)
    receive "$@"
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
    systemctl start "$unit" || {
        journalctl -q -n 10 -o cat -u "$unit" >&2
        systemctl stop "$unit"
        refuse "$name does not start"
    }
    ;;
run) # start it anew, and write its log until the connection ends
    there
    systemctl stop "$unit"
    forget
    cursor=$(journalctl -q -n 1 -o cat --show-cursor | sed -n 's/^-- cursor: //p')
    systemctl start --no-block "$unit"
    exec journalctl -q -f -o json --no-tail --after-cursor="$cursor" UNIT="$unit" + _SYSTEMD_UNIT="$unit"
    ;;
rest) # end it, and write its log from a cursor on
    systemctl stop "$unit"
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
    [ ! -e "$statistics" ] || cat "$statistics"
    ;;
status)
    there
    systemctl show -p ActiveState -p SubState -p Result -p NRestarts -p MainPID -p ActiveEnterTimestamp "$unit"
    version=$(readlink "$apps/$name")
    echo "Version=${version#*@}"
    [ -L "$wants" ] && kept=yes || kept=no
    echo "Kept=$kept"
    ;;
remove)
    there
    systemctl stop "$unit"
    rm -rf "$wants" "$system/$unit.d" "${apps:?}/$name" "$apps/.$name@"* "$apps/.$name.part" "${statistics%/*}"
    systemctl daemon-reload
    sync -f "$apps"
    ;;
esac
