#!/bin/sh
# First program of a robot in a container, in namespaces of its own: the root slot, the robot's layers over it, and the cable to the
# station. Then it becomes systemd, as preinit does on a card.
# Arguments: the robot's directory, which light.py fills; the mounted root slot; the station's network; the robot's name.
set -eu
here=$1 root=$2 station=$3 name=$4

ip link add eth0 type veth peer name "$name" netns "$station"

mount --bind "$root" "$here/root"
cd "$here/root"
mount -t proc proc proc
mount -t sysfs -o ro sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 dev dev
for node in null zero full random urandom tty; do
    : >"dev/$node"
    mount --bind "/dev/$node" "dev/$node"
done
: >dev/console
mount --bind /dev/null dev/console
mkdir dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=666,mode=620,gid=5 devpts dev/pts
ln -s pts/ptmx dev/ptmx
ln -s /proc/self/fd dev/fd
mount --bind "$here/run" run
mount --bind "$here/data" data
while read -r layer upper work; do
    mount -t overlay -o "lowerdir=$layer,upperdir=data/$upper,workdir=data/.work/$work" "$layer" "$layer"
done <<END
etc A/etc A
var var var
home home home
END

# The kernel is everybody's: nothing of it is for a robot to set, but for the network that is its own.
for place in proc/sys proc/irq proc/bus proc/sysrq-trigger; do
    [ -e "$place" ] || continue
    mount --bind "$place" "$place"
    [ "$place" != proc/sys ] || mount --bind proc/sys/net proc/sys/net
    mount -o remount,bind,ro "$place"
done
(cd "$here/files" && find . -type f) | while read -r file; do
    mount --bind "$here/files/$file" "$file"
done

pivot_root . .
umount -l .
exec env -i container=flotilla NOTIFY_SOCKET=/run/notify /sbin/init systemd.getty_auto=no
