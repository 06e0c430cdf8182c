"""An XDD written by hand from the structure of CiA 311: two profiles, objects, parameters, network."""

HEAD = (
    '<?xml version="1.0" encoding="utf-8"?>\n<ISO15745ProfileContainer xmlns="http://www.canopen.org/xml/1.0"'
    ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">'
)
PROFILE = """<ISO15745Profile><ProfileHeader/><ProfileBody xsi:type="ProfileBody_Device_CANopen"
 fileName="a.xdd" fileVersion="3" fileCreationDate="2024-05-06"><DeviceIdentity><vendorName>Maker</vendorName>
 <vendorID>0x123</vendorID><productName>Drive</productName><productID>77</productID></DeviceIdentity>
 <ApplicationProcess><parameterList>
  <parameter uniqueID="UID_1000" access="read"><label lang="en">Device type</label><UDINT/>
   <defaultValue value="0x00020192"/></parameter>
  <parameter uniqueID="UID_6060" access="readWriteOutput"><SINT/><defaultValue value="-1"/>
   <allowedValues><range><minValue value="-128"/><maxValue value="10"/></range></allowedValues></parameter>
 </parameterList></ApplicationProcess></ProfileBody></ISO15745Profile>"""
OBJECTS = """<CANopenObject index="1000" name="Device type" objectType="7" PDOmapping="no"
 uniqueIDRef="UID_1000"/>
<CANopenObject index="1800" name="TPDO 1" objectType="9" subNumber="3">
 <CANopenSubObject subIndex="00" name="Highest" objectType="7" dataType="0005" accessType="const"
  defaultValue="2" PDOmapping="no"/>
 <CANopenSubObject subIndex="01" name="COB-ID" objectType="7" dataType="0007" accessType="rw"
  defaultValue="$NODEID+0x180" PDOmapping="no" objFlags="0001"/>
 <CANopenSubObject subIndex="02" name="Type" objectType="7" dataType="0005" accessType="rw" defaultValue="255"
  PDOmapping="no"/></CANopenObject>
<CANopenObject index="6040" name="Controlword" objectType="7" dataType="0006" accessType="rw" defaultValue="0"
 PDOmapping="RPDO" lowLimit="0" highLimit="0xFFFF"/>
<CANopenObject index="6060" name="Modes" objectType="7" PDOmapping="RPDO" uniqueIDRef="UID_6060"/>
<CANopenObject index="6064" name="Position" objectType="7" dataType="0004" accessType="ro" PDOmapping="TPDO"/>
<CANopenObject index="2000" name="Gain" objectType="7" dataType="0008" accessType="rw" defaultValue="1.5"
 PDOmapping="no"/>
<CANopenObject index="2001" name="Note" objectType="7" dataType="0009" accessType="rw"
 defaultValue="a = b" PDOmapping="no"/>"""
NETWORK = """<ISO15745Profile><ProfileHeader/>
<ProfileBody xsi:type="ProfileBody_CommunicationNetwork_CANopen">
<ApplicationLayers><CANopenObjectList>{objects}</CANopenObjectList>
<dummyUsage><dummy entry="Dummy0005=1"/><dummy entry="Dummy0006=0"/></dummyUsage></ApplicationLayers>
<TransportLayers><PhysicalLayer><baudRate defaultValue="500 Kbps"><supportedBaudRate value="500 Kbps"/>
<supportedBaudRate value="1000 Kbps"/></baudRate></PhysicalLayer></TransportLayers><NetworkManagement>
<CANopenGeneralFeatures granularity="8" nrOfRxPDO="1" nrOfTxPDO="1" bootUpSlave="true"
 layerSettingServiceSlave="false"/>{commissioning}</NetworkManagement></ProfileBody></ISO15745Profile>
</ISO15745ProfileContainer>"""
COMMISSIONED = '<deviceCommissioning nodeID="9" nodeName="axis" actualBaudRate="500 Kbps" networkNumber="2"/>'


def xdd_text(objects: str = OBJECTS, commissioning: str = "", profile: str = PROFILE) -> str:
    return HEAD + profile + NETWORK.format(objects=objects, commissioning=commissioning)
