"""Electronic data sheets and device configuration files of CiA 306-1, as vendors write them.

    text.py        bytes -> lines: code page, byte order mark, line ends
    sections.py    lines -> sections with options, each with its line
    numbers.py     the spellings of numbers and of $NODEID
    objects.py     sections -> objects with typed entries, by the rules of types.py and values.py
    information.py information about the file, its device and its configuration
    model.py       objects -> the object dictionary of python canopen

Every stage reports its repairs to a :class:`servobench.drivers.sheets.eds.text.RepairLog`.
"""
