"""Reading rates of Adit beside other readers, in one sitting.

    READ_PEERS_PYTHON=venv/bin/python python3 benches/read_peers.py adit scan.las scan.laz scan.ply

Every measurement is a process of its own; the median of READ_PEERS_RUNS (3) is shown. All make positions (64 bit), colours,
intensities and labels where they can; what a reader leaves out stands beside its name. Peers that the given Python does
not have are skipped and named. The last line for each file is the physical limit: reading its bytes from the page cache
and writing as many bytes as the columns take, with one thread and no work at all.
"""
import json, os, statistics, subprocess, sys, time

PEERS = {
    'laspy': ('las', '''
import laspy
l = laspy.read(F); columns = [np.asarray(l.xyz), np.stack([l.red, l.green, l.blue], -1), np.asarray(l.intensity), np.asarray(l[LABEL])]
'''),
    'laspy, lazrs on all cores': ('laz', '''
import laspy
l = laspy.read(F, laz_backend=laspy.LazBackend.LazrsParallel)
columns = [np.asarray(l.xyz), np.stack([l.red, l.green, l.blue], -1), np.asarray(l.intensity), np.asarray(l[LABEL])]
'''),
    'MeshLib (positions only, 32 bit)': ('las laz ply', '''
import meshlib.mrmeshpy as mm
columns = mm.loadPoints(F)
'''),
    'Open3D tensor (without intensity)': ('ply', '''
import open3d as o3d
columns = o3d.t.io.read_point_cloud(F)
'''),
}
FRAME = '''
import time, resource, sys
F, LABEL = sys.argv[1], "fracture"
import numpy as np
{imports}
def cpu():
    u = resource.getrusage(resource.RUSAGE_SELF); return u.ru_utime + u.ru_stime
a, b = time.perf_counter(), cpu()
{work}
print(time.perf_counter() - a, cpu() - b, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
'''


def peer(python, work, file):
    imports = '\n'.join(l for l in work.splitlines() if l.startswith('import'))
    rest = '\n'.join(l for l in work.splitlines() if not l.startswith('import'))
    run = subprocess.run([python, '-c', FRAME.format(imports=imports, work=rest), file], capture_output=True, text=True)
    return tuple(map(float, run.stdout.split()[-3:])) if run.returncode == 0 else run.stderr.strip().splitlines()[-1:]


def adit(exe, file):
    run = subprocess.run([exe, 'info', '--json', '--rate', file], capture_output=True, text=True, check=True)
    r = json.loads(run.stdout)['reading']
    return r['wall_s'], r['cpu_s'], r['peak_mib']


def limit(file, points):
    a, c = time.perf_counter(), time.process_time()
    with open(file, 'rb', buffering=0) as f:
        buffer = bytearray(1 << 18)
        while f.readinto(buffer): pass
    bytearray(b'\1') * (points * 39)
    return time.perf_counter() - a, time.process_time() - c, 0


def show(name, rows):
    if isinstance(rows[0], tuple):
        wall, cpu, peak = (statistics.median(r[k] for r in rows) for k in range(3))
        print(f'  {name:<36} {wall:8.3f} s wall {cpu:8.2f} s CPU' + (f' {peak:8.0f} MiB' if peak else ''))
    else:
        print(f'  {name:<36} skipped: {rows[0]}')


def main():
    exe, files = sys.argv[1], sys.argv[2:]
    python, runs = os.environ.get('READ_PEERS_PYTHON'), int(os.environ.get('READ_PEERS_RUNS', 3))
    for file in files:
        points = json.loads(subprocess.run([exe, 'info', '--json', file], capture_output=True, text=True, check=True).stdout)['points']
        print(f'{os.path.basename(file)}: {points} points, {os.path.getsize(file) / 1e6:.0f} MB')
        show('adit, all columns and guards', [adit(exe, file) for _ in range(runs)])
        for name, (formats, work) in PEERS.items():
            if file.rsplit('.', 1)[-1] in formats.split() and python:
                show(name, [peer(python, work, file) for _ in range(runs)])
        show('limit: the bytes alone', [limit(file, points) for _ in range(runs)])
    if not python:
        print('READ_PEERS_PYTHON is not set: no peers were run')


main()
