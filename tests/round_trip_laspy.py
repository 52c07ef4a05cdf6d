"""Compares a LAS/LAZ file with what Adit wrote from it, through laspy.

    python round_trip_laspy.py SOURCE COPY

Every dimension of the source must be in the copy with the same bits and in the same order; version, format, scale,
offset, identifiers, dates and variable length records too. What may differ is what Adit says it changes: the four columns
that it appends, LASzip's own record, the spatial index of COPC. Ends with 1 when something differs, with 3 when laspy does
not read the source (it takes all memory for some broken headers, so memory and time are bounded).
"""
import resource
import signal
import sys
import laspy
import numpy as np

OURS = {'label', 'chainage', 'girth', 'offset'}
# What laspy calls extra bytes that no record describes; Adit describes them before it appends its own.
NOBODYS = 'ExtraBytes'


def records(found):
    return [(r.user_id, r.record_id, r.description, r.record_data_bytes()) for r in found or []
            if r.user_id not in ('laszip encoded', 'copc') and (r.user_id, r.record_id) != ('LASF_Spec', 4)]


def bits(las, name):
    array = las.points.array
    return np.asarray(array[name] if name in array.dtype.names else las[name]).tobytes()


def read_source(path):
    resource.setrlimit(resource.RLIMIT_AS, (4 << 30, resource.getrlimit(resource.RLIMIT_AS)[1]))
    signal.signal(signal.SIGALRM, lambda *_: sys.exit(3))
    signal.alarm(20)
    try:
        source = laspy.read(path)
    except BaseException as error:  # Panics of lazrs are no Exceptions.
        print(f'laspy does not read it: {type(error).__name__}')
        sys.exit(3)
    signal.alarm(0)
    return source


def main():
    source, copy = read_source(sys.argv[1]), laspy.read(sys.argv[2])
    a, b = source.header, copy.header
    wrong = []
    for name in ('version', 'uuid', 'creation_date', 'system_identifier', 'generating_software', 'file_source_id', 'point_count'):
        if getattr(a, name) != getattr(b, name):
            wrong.append(f'{name}: {getattr(a, name)!r} became {getattr(b, name)!r}')
    if a.global_encoding.value != b.global_encoding.value: wrong.append('global encoding')
    if a.point_format.id != b.point_format.id: wrong.append('point format')
    for name in ('scales', 'offsets'):
        if getattr(a, name).tobytes() != getattr(b, name).tobytes(): wrong.append(name)
    names = [d.name for d in source.point_format.dimensions if d.name not in OURS]
    for name in names:
        there = name
        if name == NOBODYS and name not in copy.point_format.dimension_names: there = 'undocumented'
        if there not in copy.point_format.dimension_names: wrong.append(f'{name} is missing')
        elif bits(source, name) != bits(copy, there): wrong.append(f'{name} differs')
    if records(a.vlrs) != records(b.vlrs): wrong.append('variable length records')
    if records(source.evlrs) != records(copy.evlrs): wrong.append('extended records')
    missing = OURS - set(copy.point_format.dimension_names)
    if missing: wrong.append(f'no columns {sorted(missing)}')
    if len(copy.points):
        if not np.allclose([copy.x.min(), copy.y.min(), copy.z.min()], b.mins, atol=2 * abs(b.scales).max()): wrong.append('lowest corner')
        if not np.allclose([copy.x.max(), copy.y.max(), copy.z.max()], b.maxs, atol=2 * abs(b.scales).max()): wrong.append('highest corner')
    print('; '.join(map(str, wrong)) or f'{len(source.points)} records, {len(names)} dimensions, {len(records(a.vlrs))} records of variable length agree')
    sys.exit(bool(wrong))


main()
