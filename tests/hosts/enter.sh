#!/bin/sh
# In mount and process namespaces of its own: a tree with a layer above it becomes the root directory, and a command
# runs there. By pivot_root, because within a chroot the kernel refuses user namespaces.
set -eu
tree=$1 layer=$2
shift 2
root=$layer/root
mkdir -p "$root" "$layer/upper" "$layer/work"
mount -t overlay -o "lowerdir=$tree,upperdir=$layer/upper,workdir=$layer/work" tree "$root"
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount --rbind /dev "$root/dev"
mount -t tmpfs -o mode=1777 tmp "$root/tmp"
cd "$root"
pivot_root . mnt
umount -l mnt
exec "$@"
