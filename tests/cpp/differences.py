"""What Python and NumPy compute otherwise than C++ that is written without care.

``SOURCE`` is a module; ``INPUTS`` has, by function, values for its parameters, one tuple per sample.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SOURCE = """\
import math

import cv2
import numpy as np

LIMIT = 5
TABLE = (3, 1, 2)


def floor_division(a, b):
    return a // b, a % b, divmod(a, b)


def float_floor_division(x, y):
    return x // y, x % y


def true_division(a, b):
    return a / b


def power(a, b):
    return a**b, a**2, -(a**2), 2**-1


def sum_of_bools(a, b):
    return (a > 0) + (b > 0), (a > 0) * 3, -(a > 0), ~(a > 0), True + True


def round_half_even(x):
    return round(x), round(-x), round(x, 1), int(x), int(-x), math.floor(x), math.ceil(x), math.trunc(-x)


def large(a):
    return a * a * 3, (a << 20) >> 20, a * 1_000_003 % 97


def shifts(a, b):
    return a >> b, a << b, -1 >> b, ~a


def bits(a, b):
    return a & b, a | b, a ^ b, a & ~b


def chained(a, b, c):
    return a < b < c, a == b == c, a < b > c, 0 <= a < LIMIT, a != b != c


def tick(log, value):
    log.append(value)
    return value


def chained_once(a, b, c):
    log = [0]
    result = tick(log, a) < tick(log, b) < tick(log, c)
    return result, log


def order_of_calls(a, b):
    log = [0]
    value = tick(log, a) - tick(log, b) * tick(log, a + b)
    pair = (tick(log, 1), tick(log, 2))
    return value, log, pair


def order_of_arguments(a, b):
    log = [0]
    return floor_division(tick(log, a), tick(log, b)), log


def short_circuit(a, b):
    log = [0]
    first = a > 0 and tick(log, b) > 0
    second = a > 0 or tick(log, b + 1) > 0
    return first, second, log


def value_of_or(a, b):
    return a or b, a and b, (a or 1.5) * 2, not a, not b


def truth(a, x, values):
    found = 0
    if a:
        found += 1
    if x:
        found += 2
    if values:
        found += 4
    if not values:
        found += 8
    return found


def ternary_of_two_types(a):
    return a if a > 3 else a + 1


def for_else(values, wanted):
    for position, value in enumerate(values):
        if value == wanted:
            break
    else:
        position = -1
    return position


def last_of_loop(n):
    i = -5
    for i in range(n):
        pass
    return i


def changed_loop_variable(n):
    total = 0
    for i in range(n):
        total += i
        i += 10
        total += i
    return total


def changed_bound(n):
    count = 0
    for _ in range(n):
        n += 1
        count += 1
    return count, n


def backwards(n):
    return [i for i in range(n, -1, -2)], list(range(3)), [i * j for i in range(n) for j in range(i)]


def while_else(a):
    while a > 3:
        a -= 2
        if a == 6:
            break
    else:
        a = -a
    return a


def swapped(a, b, c):
    a, b, c = c, a, b
    a, b = b, a + b
    return a, b, c


def chained_assignment(a):
    b = c = a + 1
    b += 1
    return b, c


def given_back(values):
    return values


def list_given_back(a):
    values = [1]
    other = given_back(values)
    values.append(a)
    return len(other)


def list_chosen(a):
    one, two = [1], [2, 3]
    chosen = one if a > 2 else two
    chosen.append(a)
    return len(one), len(two)


def list_in_list(a):
    rows = [[1], [2]]
    first = rows[0]
    first.append(a)
    for row in rows:
        row.append(a)
    return len(rows[0])


def list_grows_in_its_loop(a):
    if a > 1:
        values = [1]
    else:
        values = [2]
    for place, value in enumerate(values):
        if place < 5:
            values.append(value)
    return len(values)


def two_lists(a):
    evens, odds = [], []
    for number in range(abs(a)):
        evens.append(2 * number)
        odds.append(2 * number + 1)
    return evens, odds


def drawn_meanwhile(image):
    canvas = np.zeros((9, 9), np.uint8)
    return int(canvas.sum()) + int(cv2.rectangle(canvas, (2, 2), (5, 5), 255, -1).sum())


def clipped_to_nan(reals, x):
    return np.clip(reals, x, 2.0), np.clip(reals, 0.0, x)


def sums_of_columns(column):
    return column.sum(axis=0), column.mean(axis=0)


def enclosing_circle(a):
    (x, y), radius = cv2.minEnclosingCircle(np.array([[0, 0], [4, 0], [4, 2]], np.float32))
    return round(x), round(y), round(radius), cv2.fastAtan2(2.0, 1.0) * 1.1 + a


def same_list(values):
    other = values
    other.append(9)
    third = values[:]
    third.append(8)
    return values, other, third


def list_repeated(a):
    values = [a] * 3
    values[-1] += 1
    return values + [len(values)], values * 2


def slices_of_lists(values):
    return values[-2:], values[::-1], values[5:], values[-100:1], values[1:-1], values[::2], values[2:0:-1]


def negative_index(values):
    return values[-1], values[-len(values)], TABLE[-2]


def default_arguments(a, b=2, *, c=LIMIT):
    return a + b * c


def calls_with_defaults(a):
    return default_arguments(a), default_arguments(a, 3), default_arguments(c=1, b=a, a=7), default_arguments(a, c=0)


def shadowed_name(a, LIMIT):
    max_ = max(a, LIMIT)
    len_ = LIMIT
    return max_ + len_


def shadowed_builtin(a):
    sum = a + 1
    return sum * 2


def auto(int_, double, class_):
    template, new, this, delete, std, cv, namespace = int_, double, class_, 1, 2, 3, 4
    return template + new + this + delete + std + cv + namespace


def nested_function(a):
    step = 2

    def inner(x):
        return x * step + a

    step = 3
    return inner(a)


def late_binding(a):
    functions = [lambda: i * a for i in range(3)]
    return functions[0]()


def recursive(n):
    return 1 if n < 2 else n * recursive(n - 1)


def is_compared(a, b):
    return a is None, b is not None, (a > 2) is True


def optional(a):
    found = None
    if a > 2:
        found = a
    return found is None


def words(a, name):
    size = "large" if a > 3 else "small"
    return size == "large", size < "m", len(size), name == "red", name + "!", name in ("red", "green"), name.upper()


def formatted(a):
    return f"{a}:{a / 2}"


def sorted_values(values):
    return sorted(values), sorted(values, reverse=True), max(values), min(values), sum(values), sorted(values, key=lambda v: -v)


def sorted_pairs(values):
    pairs = [(v % 3, v) for v in values]
    pairs.sort(key=lambda pair: pair[0])
    return pairs, max(pairs), min(pairs, key=lambda pair: pair[1])


def any_of(values):
    return any(v > 3 for v in values), all(v > 3 for v in values), any([]), all([])


def zipped(values):
    return [a - b for a, b in zip(values, values[1:])], [i + v for i, v in enumerate(values, 1)], list(reversed(values))


def dictionary(a):
    table = {"x": a, "y": 2}
    table["x"] += 1
    return table["x"] + table["y"]


def nan_numbers(x):
    nan = float("nan")
    return max(x, nan), max(nan, x), min(x, nan), nan == nan, nan < x, x != x, not nan


def infinities(x):
    return x > float("-inf"), min(math.inf, x), -math.inf < x, abs(-math.inf)


def mixed_numbers(a, x):
    return a + x, a * 1.0, max(a, x) if a > x else x, a == x, 7 // 2.0, 7 % -2.5, a**0.5


def overflow_uint8(image):
    return image + 100, image * 2, image - 1, -image, image + image, 3 - image


def scalars_of_numpy(image):
    return image[0, 0] + image[0, 1], image[0, 0] - image[0, 1], image[0, 0] * 2, image[0, 0] / 2, -image[0, 0]


def integers_of_pixels(image):
    a = int(image[0, 0])
    return a + 100, a - int(image[0, 1]), image[0, 0] > 100, image[-1, -1]


def sum_of_uint8(image):
    return image.sum(), np.sum(image), image.sum(axis=0), image.mean(), image.mean(axis=1), image.sum() - 5


def minus_of_sum(image):
    return int(image.sum()) - 10_000, image.sum() // 7, image.sum() / 3


def sum_of_mask(image):
    mask = image > 100
    return mask.sum(), mask.mean(), np.count_nonzero(mask), mask.any(), mask.all(), mask + mask, mask * 2, ~mask


def overflow_int32(numbers):
    return numbers * numbers, numbers + 2_000_000_000, np.abs(numbers), numbers.sum(), numbers.prod()


def int16_arithmetic(numbers):
    return numbers // -3, numbers % -3, numbers // 7, numbers % 7, -numbers, np.abs(numbers), numbers >> 1, numbers << 1, numbers**2


def array_division(image, numbers):
    return image / 2, image // 2, numbers / 3, image / image.astype(np.float32), numbers // 2.0


def promoted(image, numbers, reals):
    return image + numbers, image * reals, numbers * reals, image * 0.5, reals * 0.1, numbers + 1.5, image - numbers


def compared_out_of_range(image):
    return image < 300, image > -1, image == 256, image != -1, image <= 255


def compared_types(image, numbers):
    return image < numbers, image == numbers, numbers > 3.5, (image > 3) & (numbers < 0), (image > 3) | ~(image > 99)


def astype_wraps(numbers, reals):
    return numbers.astype(np.uint8), numbers.astype(np.int8), reals.astype(np.int32), reals.astype(bool), numbers.astype(np.float32)


def clipped(numbers, reals):
    return np.clip(numbers, 0, 255).astype(np.uint8), np.clip(reals, -1, 1), np.clip(reals, None, 2.5), numbers.clip(-5, 5), np.clip(reals, 2, 1)


def rounded(reals):
    return np.round(reals), np.floor(reals), np.ceil(reals), np.rint(reals).astype(np.int32), reals.astype(np.int16), np.trunc(reals)


def where_mixed(image, numbers, reals):
    mask = image > 3
    return np.where(mask, image, numbers), np.where(mask, image, 0), np.where(mask, reals, numbers), np.where(mask, 1, 0), np.where(mask, 1, 0.5), np.where(mask, reals, 0)


def nan_arrays(reals):
    x = reals.copy()
    x[0, 0] = np.nan
    return x.min(), x.max(), np.argmax(x), np.argmin(x), np.sort(x, axis=None), np.sort(x, axis=1), x == x, np.maximum(x, 1), np.isnan(x), np.nanmax(x), np.where(x > 0, x, -1), np.clip(x, 0, 1)


def equal_maxima(image):
    image = np.minimum(image, 9)
    return np.argmax(image), image.argmin(), np.argmax(image, axis=0), np.argmax(image, axis=1)


def slices(image):
    return image[1:], image[:, ::-1], image[-2:], image[::-2], image[5:1:-1], image[1:-1, 1:-1], image[:100, -100:2], image[0], image[:, -1], image[..., 0]


def empty(image):
    part = image[2:2]
    return part.sum(), part.size, len(part), part.shape, (part > 3).any(), (part > 3).all(), image[image > 255].sum()


def mean_of_empty(image):
    found = image[image > 250]
    return found.mean() if found.size else -1.0


def views(image):
    own = image.copy()
    view = own[1:]
    view[0] = 7
    own[1, 0] = 8
    copied = own[1:].copy()
    own[-1] = 9
    return own, view, copied


def view_in_place(image):
    own = image.copy()
    view = own[:, 1:]
    view += 100
    alias = own
    alias[0] = 1
    alias = alias + 1
    return own, alias


def overlapping(image):
    own = image.copy()
    own[1:] = own[:-1]
    other = image.copy()
    other[:, :-1] += other[:, 1:]
    return own, other


def row_of_copy(image):
    own = image.copy()
    row = own[0]
    own[0, 0] = 77
    row[1] = 78
    element = own[0, 0]
    own[0, 0] = 79
    return own, row, element


def masked_assignment(image):
    own = image.copy()
    own[own > 100] = 0
    own[own < 3] += 5
    own[image == 7] = image[image == 7] * 2
    return own, own[own > 4]


def called_with_array(image):
    own = image.copy()
    cleared(own)
    return own


def cleared(array):
    array[0] = 0
    array = array + 1
    return array


def augmented_float(image, reals):
    own = reals.copy()
    own *= 2
    own += image
    own /= 3
    return own


def augmented_rebinds(a):
    b = a
    b += 1
    x = (a, b)
    x += (3,)
    return a, b, x


def shape_and_size(image, colour):
    h, w = image.shape
    return h, w, image.shape[::-1], image.size, colour.shape, colour.shape[:2], image.ndim, len(colour), h // 2, w / 2


def channels(colour):
    b, g, r = cv2.split(colour)
    return colour[:, :, 0], colour[..., 2] - colour[..., 1], b + g, cv2.merge([r, g, b]), colour[0, 0], colour[:, :, ::-1], colour.sum(axis=2), colour.max(axis=2)


def channel_assignment(colour):
    own = colour.copy()
    own[:, :, 1] = 0
    own[own[:, :, 0] > 100] = (1, 2, 3)
    own[0, 0] = [4, 5, 6]
    return own


def broadcast(image, colour):
    row = image[0]
    column = image[:, :1]
    return image + row, image - column, row + column, colour * np.array([1, 2, 3], np.uint8), image[:, :, None] + colour, colour - colour.mean(axis=(0, 1))


def made(n):
    return np.zeros((n, 2)), np.ones(n, np.uint8), np.full((2, n), 7), np.arange(n), np.arange(1, 2, 0.25), np.linspace(0, 1, n), np.eye(n), np.array([[1, 2], [3, n]]), np.array([0.5, n])


def stacked(image):
    return np.hstack([image, image]), np.vstack([image, image + 1]), np.concatenate([image, image], axis=1), np.dstack([image, image]), np.stack([image, image])


def found_positions(image):
    ys, xs = np.nonzero(image > 100)
    return ys, xs, np.argwhere(image > 100), np.where(image > 100), np.unique(image), np.bincount(image.ravel())[:3]


def statistics(image, reals):
    return image.std(), reals.var(), np.median(image), np.percentile(reals, 25), np.cumsum(image), np.histogram(image, 4)[0], np.diff(image, axis=1)


def reshaped(image):
    return image.reshape(-1), image.T, image.flatten()[::2], image.reshape(1, -1), image.ravel().sum(), image.T.reshape(-1)


def products(reals):
    return reals @ reals.T, np.dot(reals[0], reals[1]), np.linalg.norm(reals), reals.sum(), np.outer(reals[0], reals[0])


def saturated(image):
    return cv2.add(image, image), image + image, cv2.subtract(image, 100), cv2.add(image, 100), cv2.absdiff(image, 100)


def keywords(image):
    return cv2.GaussianBlur(image, ksize=(3, 3), sigmaX=0), cv2.blur(src=image, ksize=(3, 5)), cv2.copyMakeBorder(image, 1, 2, 3, 4, cv2.BORDER_CONSTANT, value=9)


def outputs_of_opencv(image):
    level, mask = cv2.threshold(image, 50, 255, cv2.THRESH_BINARY)
    otsu, _ = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    low, high, low_at, high_at = cv2.minMaxLoc(image)
    count, labels = cv2.connectedComponents(mask)
    return level, mask, otsu, low, high, low_at, high_at, count, labels, cv2.mean(image), cv2.countNonZero(mask)


def contours(image):
    found, hierarchy = cv2.findContours((image > 50).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return len(found), sorted(cv2.contourArea(each) for each in found), [cv2.boundingRect(each) for each in found]


def drawn(image):
    own = image.copy()
    cv2.rectangle(own, (0, 0), (2, 2), 9, -1)
    cv2.line(own, (0, 3), (3, 0), color=200, thickness=1)
    drawn_on = cv2.circle(image.copy(), (2, 2), 1, 255)
    return own, drawn_on


def input_in_place(image):
    return cv2.dilate(image, None), cv2.erode(image[1:, 1:], np.ones((2, 2), np.uint8)), image


def written_out(image):
    out = np.zeros_like(image)
    cv2.bitwise_not(image, out)
    cv2.flip(image, 0, dst=out)
    return out


def moved_window(image, n):
    level = float(image[0, 0])
    for y in range(1, len(image)):
        level = 0.9 * level + 0.1 * image[y, 0]
        if level > 200:
            return level, y
    return level, -n


def early_return(a):
    if a > 3:
        return 1, 2.5
    for i in range(a):
        if i == 1:
            return i, 0.5
    return 0, 0.0


def returns_none(a):
    if a > 100:
        return 1


def unbound_after_branch(a):
    if a > -100:
        b = a
    return b


def type_changes(a):
    b = a
    b = b / 2
    b = [b]
    return b


def asserted(a):
    assert a > -100, "too small"
    return a


def raised(a):
    if a < -100:
        raise ValueError("too small")
    try:
        return 10 // a
    except ZeroDivisionError:
        return -1


def star(values):
    first, *rest = values
    return first, rest, max(*values)


def with_global(a):
    return sum(TABLE) + TABLE[a % 3] + len(TABLE)


def generator(values):
    return sum(v * v for v in values), max((v for v in values if v > 0), default=-1), len({v % 3 for v in values})


def walrus(a):
    if (b := a * 2) > 4:
        return b
    return -b


def drifting(n):
    x = 0
    for _ in range(n):
        x = x - 3
    return x // 2, x % 4, x >> 1


def drifting_while(n):
    x, y = 10, 1
    while n > 0:
        n -= 1
        x -= 7
        y = -y * 2
    return x // 4, x % 4, y, n


def drifting_branch(a, b):
    x = 5
    if a > b:
        x = a - 9
    elif a < b:
        x -= 20
    return x // 2, x % 3


def growing(n):
    x = 1
    for _ in range(n):
        x = x * 1000
    return x % 97


def argument_of_either_sign(a):
    return halved(4), halved(a), halved(-5), halved(a * a)


def halved(x):
    return x // 2, x % 3


def compared_sums(image):
    total = image.sum()
    return total > -1, total == -1, total >= 0, image[0, 0] > -1, image.max() < 300, image.sum() - 1 < 0, total > 2.5, image[0, 0] == 5.0


def numbers_of_float32(reals):
    x = reals[0, 0]
    return x * 0.1, float(x) * 0.1, x + 1, x / 3, reals.max() - reals.min(), x > 0.1, reals.sum() / 7, -x, x * x, abs(x), int(x), round(float(x), 1)


def numbers_of_int64(image):
    at = np.argmax(image)
    count = np.count_nonzero(image > 99)
    return at // 2 - 5, (at - 7) // 2, (at - 7) % 3, count / 2, count * 1.5, at * at, count - 100, -count


def number_of_mask(image):
    big = image[0, 0] > 4
    return big, not big, big and image[0, 1] > 4, int(big) + 1, 1 if big else 0


def sorted_with_ties(image):
    row = image.reshape(-1) // 50
    return np.argsort(row), np.argsort(row, kind="stable"), np.argsort(-row.astype(np.int16), kind="stable")


def break_of_inner_loop(n):
    found = []
    for i in range(n):
        for j in range(n):
            if j > i:
                break
            if (i + j) % 2:
                continue
            found.append(i * 10 + j)
        else:
            found.append(-i)
    return found, i, j


def forever(a):
    n = 0
    while True:
        n += 1
        if a + n > 9:
            break
    return n


def loop_without_turns(values):
    total = 0
    for v in values[9:]:
        total = v
    last = [v for v in values if v > 99]
    return total, last + [1]


def loop_over_image(image):
    total, brightest = 0, (-1, -1)
    best = -1
    for y, row in enumerate(image):
        for x, value in enumerate(row):
            total += int(value)
            if value > best:
                best, brightest = value, (x, y)
    return total, brightest, int(best)


def rows_of_image(image):
    heights = [int(row.max()) for row in image]
    return heights, [len(row) for row in image[1:]], sum(row[0] > 5 for row in image)


def array_of_list(values):
    grown = []
    for v in values:
        if v > 0:
            grown.append((v, v * 2))
    return np.array([v / 2 for v in values]), np.array(values), len(grown)


def swapped_rows(image):
    own = image.copy()
    own[0], own[1] = own[1], own[0]
    return own


def swapped_elements(values):
    own = list(values)
    own[0], own[-1] = own[-1], own[0]
    own[0] += 5
    return own


def returned_views(image):
    own = image.copy()
    left, right = own[:, :1], own[:, 1:]
    own[0] = 9
    return left, right


def views_in_lists(image):
    own = image.copy()
    views = [own[::-1], own[:, ::-1]]
    views.append(cv2.blur(own, (3, 3)))
    own[0] = 9
    for view in views:
        view[1, 1] = 7
    for part in [own[:2], own[2:]]:
        cv2.rectangle(part, (1, 0), (2, 0), 200, -1)
    views[0][2, 2] = 5
    return cv2.hconcat(views), cv2.vconcat([own[::-1], own[::2], views[1]]), own


def listed_views(array):
    return [array[::-1], cv2.blur(array, (3, 3))]


def views_of_helper(image):
    own = image.copy()
    views = listed_views(own)
    own[0] = 9
    one, other = views
    return one, cv2.hconcat(views), other


def reshaped_columns(image):
    own = image.copy()
    column, pairs, apart, row = own[:, 0].reshape(-1, 1), own[:2, ::2].reshape(2, 1, -1), own[::2].reshape(-1), own[:, 1].ravel()
    own[0] = 99
    return column, pairs[:, 0], apart, row


def calculated_of_transposed(image):
    turned = image.T + 1
    flat, whole = turned.reshape(-1), image.T.copy().ravel()
    return flat, np.ascontiguousarray(turned), whole, np.zeros_like(image.T)


def written_after_transposed(image):
    turned = image.T.astype(np.int32)
    flat = turned.ravel()
    turned[0, 1] = 99
    return flat


def written_after_nonzero(image):
    rows, columns = np.nonzero(image > 9)
    flat = rows.ravel()
    rows[0] = 99
    return flat


def nested_input_in_place(groups):
    for group in groups:
        for values in group:
            if len(groups) > 5:
                values[0] = 1
    return groups[0][0]


def listed_rows(image):
    rows = []
    for row in image:
        if row[0] > 5:
            rows.append(row)
    return rows


def rows_of_helper(image):
    own = image.copy()
    rows = listed_rows(own)
    own[1] = 3
    return rows[0], len(rows)


def drawn_on_a_copy(image):
    own = image.copy()
    cv2.rectangle(own[1:], (1, 1), (2, 1), 70, -1)
    drawn = cv2.rectangle(image.copy(), (1, 1), (2, 2), 200, -1)
    return drawn, own


def none_of_opencv(image):
    contours, hierarchy = cv2.findContours(image * 0, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    one = np.zeros((5, 1, 2), np.float32)
    found, _ = cv2.findHomography(one, one)
    part, lines = cv2.intersectConvexConvex(one[:3], one[:3] + 5)[1], cv2.HoughLines(image * 0, 1, 0.1, 99)
    kept = lines if lines is not None else cv2.HoughLines(image * 0 + 255, 1, 0.1, 2)
    made = hierarchy is None and found is None and lines is None and kept is not None
    return made, 1 if part is None else 2, image is None, cv2.blur(image, (3, 3)) is not None, float(kept[0, 0, 1])


def masked_rows(colour, image):
    own = colour.copy()
    own[image > 9] = (1, 2, 3)
    own[image == 7] = own[0, 0]
    own[:, ::2][image[:, ::2] > 99] = [7]
    own[image > 150] //= 2
    own[image < 9] = own[image < 9][::-1]
    return own


def several_names(a):
    b = c = a + 1
    c += 1
    first = second = np.zeros(3)
    first[0] = b
    return b, c, second


def array_of_either_kind(image):
    found, last = np.zeros(image.shape, np.uint8), image
    for shift in range(3):
        found = cv2.bitwise_or(found, cv2.blur(image, (3, 3)))
        last = found[::-1] if shift == 1 else cv2.flip(last, 0)
    found[0] = 5
    return found, last


def extremes_of_two_types(a, x):
    return int(max(0, x)), int(min(255, x * a)), float(max(2, x)), cv2.threshold(np.uint8([[3, 9]]), max(5, x), 8, 0)[1]


def added_in_a_loop_over_itself(values):
    kept = []
    for value in values:
        for other in kept:
            if other == value:
                break
        else_ = len(kept)
        if else_ < 2:
            kept.append(value)
    return kept


def array_in_two_names(image):
    own = np.zeros_like(image)
    other = own
    other[0, 0] = 3
    own = own + 1
    return own, other


def appended_rows(image):
    row = np.zeros(3, np.uint8)
    rows = []
    for i in range(3):
        row[i] = i + 1
        rows.append(row)
    return rows[0], rows[2]


def filled_in_helper(image):
    mask = np.zeros_like(image)
    painted(mask, 7)
    return mask


def painted(mask, value):
    mask[1:, 1:] = value
    cv2.rectangle(mask, (0, 0), (1, 1), 3, -1)


def opencv_of_view(image):
    own = image.copy()
    cv2.rectangle(own[1:, 1:], (0, 0), (1, 1), 77, -1)
    flipped = own[:, ::-1]
    return own, cv2.add(flipped, own), cv2.countNonZero(own[:, ::2].copy())


def floats_to_opencv(x):
    return cv2.norm(np.array([x, 2.0])), cv2.fastAtan2(x, 2.0)


def truncated_points(x):
    return int(x + 0.5), int(x) + 0.5, int(x * 3) // 2


def text_of_type(image):
    return image.dtype == np.uint8, image.ndim == 2, str(image.dtype), image.shape == (5, 4)


def none_argument(a):
    return with_none(a), with_none(a, 3), with_none(a, None)


def with_none(a, b=None):
    if b is None:
        b = 10
    return a + b
"""

_GRID = np.array(
    [[5, 200, 3, 7], [100, 150, 99, 250], [0, 255, 7, 1], [9, 51, 180, 20], [255, 254, 100, 101]], np.uint8
)
_OTHER = np.array([[251, 255, 0, 9], [90, 6, 6, 2], [7, 7, 7, 101]], np.uint8)
_IMAGES = [(_GRID,), (_OTHER,)]
_NUMBERS = [
    (_GRID.astype(np.int16) * 130 - 7000,),
    (np.array([[-32768, 32767, 0], [-7, 7, -1], [3, -3, 256]], np.int16),),
]
_WIDE = [(_GRID.astype(np.int32) * 8_000_000 - 7,), (np.array([[-(2**31), 2**31 - 1], [-7, 46341]], np.int32),)]
_REALS = [
    (_GRID.astype(np.float32) / 8 - 9,),
    (np.array([[0.5, 1.5, 2.5, -0.5], [-1.5, -2.5, 0.1, -0.0], [1e4, -1e4, 3.7, -3.7]], np.float32),),
]
_COLOUR = np.stack([_GRID, _GRID[::-1], _GRID // 2], axis=2)
_COLOURS = [(_COLOUR,), (_COLOUR[:3, ::-1].copy(),)]
_INTS = [(7,), (0,), (-7,), (4,)]
_PAIRS = [(7, 3), (-7, 3), (7, -3), (-7, -3), (6, 3), (0, 5)]
_TRIPLES = [(1, 2, 3), (3, 2, 1), (2, 2, 2), (1, 3, 2), (-1, 0, 9)]
_FLOATS = [(2.5,), (0.5,), (1.5,), (-3.7,), (0.0,), (0.25,), (1e15,)]
_LISTS = [([5, -3, 8, 1, 1],), ([4],), ([-2, 7, 7],)]
_IMAGES_AND_NUMBERS = [
    (image, np.resize(numbers, image.shape)) for (image,), (numbers,) in zip(_IMAGES, _NUMBERS, strict=True)
]
_IMAGES_AND_REALS = [(image, np.resize(reals, image.shape)) for (image,), (reals,) in zip(_IMAGES, _REALS, strict=True)]
_NUMBERS_AND_REALS = [
    (numbers, np.resize(reals, numbers.shape)) for (numbers,), (reals,) in zip(_NUMBERS, _REALS, strict=True)
]
_ALL_THREE = [(*pair, reals[1]) for pair, reals in zip(_IMAGES_AND_NUMBERS, _IMAGES_AND_REALS, strict=True)]

INPUTS: dict[str, list[tuple[Any, ...]]] = {
    "floor_division": _PAIRS,
    "float_floor_division": [(7.5, 2.0), (-7.5, 2.0), (7.5, -2.0), (-1e-20, 3.0), (6.0, 3.0), (0.3, 0.1)],
    "true_division": _PAIRS,
    "power": [(2, 3), (-2, 3), (-3, 2), (0, 0)],
    "sum_of_bools": _PAIRS,
    "round_half_even": _FLOATS,
    "large": [(7,), (1_000_000,), (-1_000_003,)],
    "shifts": [(7, 1), (-7, 1), (-1, 3), (5, 0), (-8, 2)],
    "bits": _PAIRS,
    "chained": _TRIPLES,
    "chained_once": _TRIPLES,
    "order_of_calls": _PAIRS,
    "order_of_arguments": _PAIRS,
    "short_circuit": [*_PAIRS, (-1, -1)],
    "value_of_or": [(7, 3), (0, 3), (2, 0), (0, 0)],
    "truth": [(1, 0.5, [1]), (0, 0.0, [0]), (-1, -0.0, [2, 3])],
    "ternary_of_two_types": _INTS,
    "for_else": [([1, 2, 3], 2), ([1, 2, 3], 9), ([5], 5)],
    "last_of_loop": [(3,), (0,)],
    "changed_loop_variable": [(3,), (0,)],
    "changed_bound": [(3,), (0,)],
    "backwards": [(5,), (0,), (1,)],
    "while_else": [(9,), (8,), (0,)],
    "swapped": _TRIPLES,
    "chained_assignment": _INTS,
    "list_given_back": _INTS,
    "list_chosen": _INTS,
    "list_in_list": _INTS,
    "list_grows_in_its_loop": _INTS,
    "two_lists": _INTS,
    "drawn_meanwhile": _IMAGES,
    "clipped_to_nan": [(*reals, x) for reals in _REALS for x in (float("nan"), 1.0)],
    "sums_of_columns": [(np.linspace(-1, 7, 1000, dtype=np.float32).reshape(-1, 1) ** 3,)],
    "enclosing_circle": _INTS,
    "same_list": _LISTS,
    "list_repeated": _INTS,
    "slices_of_lists": _LISTS,
    "negative_index": _LISTS,
    "calls_with_defaults": _INTS,
    "shadowed_name": _PAIRS,
    "shadowed_builtin": _INTS,
    "auto": _TRIPLES,
    "nested_function": _INTS,
    "late_binding": _INTS,
    "recursive": [(5,), (1,)],
    "is_compared": _PAIRS,
    "optional": _INTS,
    "words": [(7, "red"), (0, "blue")],
    "formatted": [(7,), (2,)],
    "sorted_values": _LISTS,
    "sorted_pairs": _LISTS,
    "any_of": _LISTS,
    "zipped": [([5, -3, 8, 1, 1],), ([-2, 7, 7],)],
    "dictionary": _INTS,
    "nan_numbers": [(1.5,), (-2.0,)],
    "infinities": [(1.5,), (-2.0,)],
    "mixed_numbers": [(7, 2.5), (2, 2.0), (0, -0.5)],
    "overflow_uint8": _IMAGES,
    "scalars_of_numpy": _IMAGES,
    "integers_of_pixels": _IMAGES,
    "sum_of_uint8": _IMAGES,
    "minus_of_sum": _IMAGES,
    "sum_of_mask": _IMAGES,
    "overflow_int32": _WIDE,
    "int16_arithmetic": _NUMBERS,
    "array_division": _IMAGES_AND_NUMBERS,
    "promoted": _ALL_THREE,
    "compared_out_of_range": _IMAGES,
    "compared_types": _IMAGES_AND_NUMBERS,
    "astype_wraps": _NUMBERS_AND_REALS,
    "clipped": _NUMBERS_AND_REALS,
    "rounded": _REALS,
    "where_mixed": _ALL_THREE,
    "nan_arrays": _REALS,
    "equal_maxima": _IMAGES,
    "slices": _IMAGES,
    "empty": _IMAGES,
    "mean_of_empty": _IMAGES,
    "views": _IMAGES,
    "view_in_place": _IMAGES,
    "overlapping": _IMAGES,
    "row_of_copy": _IMAGES,
    "masked_assignment": _IMAGES,
    "called_with_array": _IMAGES,
    "augmented_float": _IMAGES_AND_REALS,
    "augmented_rebinds": _INTS,
    "shape_and_size": [(_GRID, _COLOUR), (_OTHER, _COLOUR[:2])],
    "channels": _COLOURS,
    "channel_assignment": _COLOURS,
    "broadcast": [(_GRID, _COLOUR), (_GRID[:3], _COLOUR[:3])],
    "made": [(3,), (5,)],
    "stacked": _IMAGES,
    "found_positions": _IMAGES,
    "statistics": _IMAGES_AND_REALS,
    "reshaped": _IMAGES,
    "products": _REALS,
    "saturated": _IMAGES,
    "keywords": _IMAGES,
    "outputs_of_opencv": _IMAGES,
    "contours": _IMAGES,
    "drawn": _IMAGES,
    "input_in_place": _IMAGES,
    "written_out": _IMAGES,
    "moved_window": [(_GRID, 3), (_OTHER, 4)],
    "early_return": _INTS,
    "returns_none": _INTS,
    "unbound_after_branch": _INTS,
    "type_changes": _INTS,
    "asserted": _INTS,
    "raised": _INTS,
    "star": [([5, -3, 8],), ([4, 9],)],
    "with_global": _INTS,
    "generator": _LISTS,
    "walrus": _INTS,
    "drifting": [(3,), (0,), (4,)],
    "drifting_while": [(3,), (0,), (4,)],
    "drifting_branch": _PAIRS,
    "growing": [(3,), (0,), (8,)],
    "argument_of_either_sign": _INTS,
    "compared_sums": _IMAGES,
    "numbers_of_float32": _REALS,
    "numbers_of_int64": _IMAGES,
    "number_of_mask": _IMAGES,
    "sorted_with_ties": _IMAGES,
    "break_of_inner_loop": [(3,), (4,)],
    "forever": _INTS,
    "loop_without_turns": _LISTS,
    "loop_over_image": _IMAGES,
    "rows_of_image": _IMAGES,
    "array_of_list": _LISTS,
    "swapped_rows": _IMAGES,
    "swapped_elements": _LISTS,
    "returned_views": _IMAGES,
    "views_in_lists": _IMAGES,
    "views_of_helper": _IMAGES,
    "reshaped_columns": _IMAGES,
    "calculated_of_transposed": _IMAGES,
    "written_after_transposed": _IMAGES,
    "written_after_nonzero": _IMAGES,
    "nested_input_in_place": [([[_GRID[0], _GRID[1]]],)],
    "rows_of_helper": _IMAGES,
    "drawn_on_a_copy": _IMAGES,
    "none_of_opencv": _IMAGES,
    "masked_rows": [(_COLOUR, _GRID), (_COLOUR[:3], _GRID[:3])],
    "several_names": _INTS,
    "array_of_either_kind": _IMAGES,
    "extremes_of_two_types": [(7, 2.5), (-3, -0.5), (4, 300.25)],
    "added_in_a_loop_over_itself": _LISTS,
    "array_in_two_names": _IMAGES,
    "appended_rows": _IMAGES,
    "filled_in_helper": _IMAGES,
    "opencv_of_view": _IMAGES,
    "floats_to_opencv": _FLOATS,
    "truncated_points": _FLOATS,
    "text_of_type": _IMAGES,
    "none_argument": _INTS,
}
