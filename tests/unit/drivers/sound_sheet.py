"""A sound data sheet, and what tests of the reader ask of one."""

from servobench.drivers.sheets.dictionary import LoadedDictionary, parse_dictionary

SOUND = """[FileInfo]
FileName=sound.eds
[DeviceInfo]
VendorNumber=0x1234
BaudRate_1000=1
[DummyUsage]
Dummy0001=0
Dummy0002=1
[MandatoryObjects]
SupportedObjects=2
1=0x1000
2=0x1800
[OptionalObjects]
SupportedObjects=2
1=0x607D
2=0x1003
[ManufacturerObjects]
SupportedObjects=1
1=0x2000
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0
[1800]
ParameterName=TPDO 1
ObjectType=0x9
SubNumber=2
[1800sub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=1
[1800sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x180
[607D]
ParameterName=Software position limit
ObjectType=0x8
SubNumber=3
[607Dsub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=2
[607Dsub1]
ParameterName=Minimum
ObjectType=0x7
DataType=0x0004
AccessType=rw
DefaultValue=0x80000000
LowLimit=0x80000000
HighLimit=0x7FFFFFFF
[607Dsub2]
ParameterName=Maximum
ObjectType=0x7
DataType=0x0004
AccessType=rww
DefaultValue=1000
PDOMapping=1
[1003]
ParameterName=Error field
ObjectType=0x8
CompactSubObj=4
DataType=0x0007
AccessType=ro
[2000]
ParameterName=Note
ObjectType=0x7
DataType=0x0009
AccessType=rw
DefaultValue=a = b
"""


def parse(text: str | bytes, node_id: int | None = 5) -> LoadedDictionary:
    data = text if isinstance(text, bytes) else text.encode()
    return parse_dictionary(data, "test.eds", node_id)


def value(loaded: LoadedDictionary, index: int, sub: int = 0) -> object:
    variable = loaded.dictionary.get_variable(index, sub)
    assert variable is not None
    return variable.default


def repairs(loaded: LoadedDictionary) -> str:
    return "\n".join(map(str, loaded.repairs))


def line_of(text: str, content: str) -> int:
    return text[: text.index(content)].count("\n") + 1
