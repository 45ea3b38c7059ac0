"""The tool frame as it is typed at the pendant of a robot, or put into its program."""
from __future__ import annotations

from functools import partial

from handeye_ros import orientations
from handeye_ros.data import Calibration
from handeye_ros.results.exports.format import commented, Format, position
import numpy as np
from scipy.spatial.transform import Rotation

DIGITS = {'mm': 4, 'm': 7, 'deg': 5, 'rad': 8, '': 9}


def text(calibration: Calibration, vendor: str, mark: str, line: str) -> str:
    """
    Return the sensor's pose as numbers with their names, and as a line of a program.

    mark: how a comment begins there; line: with {xyz}, {angles}, and {x}, {a} and so on.
    """
    notation = orientations.of(vendor)
    unit = 1e3 if notation.length == 'mm' else 1.0
    lengths = [f'{v:.{DIGITS[notation.length]}f}' for v in position(calibration) * unit]
    R = Rotation.from_matrix(calibration.T_flange_sensor[:3, :3])
    angles = [f'{v + 0.0:.{DIGITS[notation.angle]}f}' for v in np.ravel(notation.numbers(R))]
    named = dict(zip(('x', 'y', 'z', *notation.labels), [*lengths, *angles], strict=True))
    units = [notation.length] * 3 + [notation.angle] * len(angles)
    rows = [f'{mark}{name.upper():3} {value} {unit}'.rstrip()
            for (name, value), unit in zip(named.items(), units, strict=True)]
    shown = {**named, 'xyz': ','.join(lengths), 'angles': ','.join(angles)}
    return commented(calibration, mark, f'{notation.title}.') + '\n'.join(
        [*rows, line.format(**shown)]) + '\n'


def _form(vendor: str, what: str, name: str, mark: str, line: str) -> Format:
    return Format(what, partial(_file_name, name),
                  partial(text, vendor=vendor, mark=mark, line=line))


def _file_name(name: str, calibration: Calibration) -> str:
    return name


FORMATS = {
    'kuka': _form('kuka', 'KUKA: X Y Z A B C of a tool, and a FRAME of KRL', 'tool_kuka.dat', '; ',
                  'DECL FRAME SENSOR={{X {x},Y {y},Z {z},A {a},B {b},C {c}}}'),
    'fanuc': _form('fanuc', 'FANUC: X Y Z W P R of a tool frame', 'tool_fanuc.txt', '! ',
                   'X: {x} Y: {y} Z: {z} W: {w} P: {p} R: {r}'),
    'abb': _form('abb', 'ABB: a pose of RAPID, the tframe of tooldata', 'tool_abb.mod', '! ',
                 'CONST pose sensor:=[[{xyz}],[{angles}]];'),
    'ur': _form('ur', 'Universal Robots: a pose of URScript for set_tcp', 'tool_ur.script', '# ',
                'set_tcp(p[{xyz},{angles}])'),
    'staubli': _form('staubli', 'Staubli: X Y Z Rx Ry Rz of a tool', 'tool_staubli.txt', '// ',
                     '{{{x}, {y}, {z}, {rx}, {ry}, {rz}}}'),
    'yaskawa': _form('yaskawa', 'Yaskawa: X Y Z Rx Ry Rz of a tool', 'tool_yaskawa.txt', '; ',
                     '{xyz},{angles}'),
}
